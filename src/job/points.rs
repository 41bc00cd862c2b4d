//! A list of points: a line each, three coordinates.

use crate::error::{Error, Result};
use glam::DVec3;
use std::io::Read;
use std::path::Path;

/// No list of points that somebody picked is longer.
const LONGEST_BYTES: u64 = 1 << 20;

/// Reads points, `x y z` a line; empty lines and what follows a `#` are passed over.
pub fn read_points(path: &Path) -> Result<Vec<DVec3>> {
    let wrong = |what: String| Error::Usage { what: format!("{}: {what}", path.display()), file: Some(path.into()) };
    let mut text = String::new();
    std::fs::File::open(path)
        .and_then(|file| file.take(LONGEST_BYTES + 1).read_to_string(&mut text))
        .map_err(|e| wrong(format!("cannot read the list of points: {e}")))?;
    if text.len() as u64 > LONGEST_BYTES {
        return Err(wrong(format!("not a list of points: it is longer than {LONGEST_BYTES} bytes")));
    }
    let lines = text.lines().enumerate().map(|(i, line)| (i, line.split('#').next().unwrap_or("").trim()));
    let points = lines.filter(|(_, line)| !line.is_empty());
    points
        .map(|(i, line)| point(line).ok_or_else(|| wrong(format!("line {}: expected x y z, found `{line}`", i + 1))))
        .collect()
}

fn point(line: &str) -> Option<DVec3> {
    let numbers: Vec<f64> = line.split_whitespace().map(str::parse).collect::<Result<_, _>>().ok()?;
    let point = DVec3::from_array(numbers.try_into().ok()?);
    point.is_finite().then_some(point)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_read_and_what_is_none_is_named_with_its_line() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "# horns\n1 2 3\n\n-4.5 5e1 6 # the left one\n").unwrap();
        assert_eq!(read_points(file.path()).unwrap(), [DVec3::new(1.0, 2.0, 3.0), DVec3::new(-4.5, 50.0, 6.0)]);
        for line in ["1 2", "1 2 3 4", "a b c", "1 2 inf"] {
            std::fs::write(file.path(), format!("1 2 3\n{line}\n")).unwrap();
            let error = read_points(file.path()).unwrap_err();
            assert!(error.to_string().contains("line 2") && error.exit_code() == 2, "{error}");
        }
        assert_eq!(read_points(Path::new("/nowhere/at/all")).unwrap_err().exit_code(), 2);
    }
}
