//! Where a scan's meshes go: `{dir}/{stem}.{faces}.{ext}`.

use super::expand::unpacked;
use crate::error::{Error, Result};
use crate::job::Target;
use std::path::{Component, Path, PathBuf};

const WORDS: [&str; 4] = ["dir", "stem", "faces", "ext"];

/// A scan, and the part of its path that is mirrored.
pub(super) struct Named<'a> {
    /// The scan.
    pub(super) scan: &'a Path,
    /// Its folder, below that which a pattern begins with.
    pub(super) dir: &'a Path,
}

impl Named<'_> {
    /// The path that the template gives.
    pub(super) fn output(&self, template: &Path, target: Target) -> Result<PathBuf> {
        let text = unicode(template)?;
        let mut path = String::new();
        let mut rest = text;
        while let Some((before, after)) = rest.split_once('{') {
            path.push_str(before);
            let Some((word, after)) = after.split_once('}') else {
                return Err(Error::usage(format!("output {text}: `{{` without `}}`")));
            };
            path.push_str(&self.word(word, text, target)?);
            rest = after;
        }
        path.push_str(rest);
        // `{dir}` of a scan that lies at the top is empty.
        let absolute = if text.starts_with('/') { "/" } else { "" };
        let parts = Path::new(&path).components().filter(|part| !matches!(part, Component::RootDir));
        Ok(Path::new(absolute).join(parts.collect::<PathBuf>()))
    }

    fn word(&self, word: &str, template: &str, target: Target) -> Result<String> {
        Ok(match word {
            "dir" => unicode(self.dir)?.into(),
            "stem" => unicode(Path::new(unpacked(self.scan).file_stem().unwrap_or_default()))?.into(),
            "faces" => target.to_string(),
            "ext" => self.extension().into(),
            other => {
                let near = |word: &&&str| strsim::damerau_levenshtein(other, word);
                let meant = WORDS.iter().min_by_key(near).filter(|word| near(word) <= 2);
                let hint = meant.map_or(String::from("there are {dir}, {stem}, {faces} and {ext}"), |word| {
                    format!("did you mean `{{{word}}}`?")
                });
                return Err(Error::usage(format!("output {template}: unknown `{{{other}}}`; {hint}")));
            }
        })
    }

    /// The scan's own ending where that can be written, otherwise that of PLY.
    fn extension(&self) -> &'static str {
        let own = unpacked(self.scan).extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        match own.as_deref() {
            Some("stl") => "stl",
            Some("obj") => "obj",
            Some("glb" | "gltf") => "glb",
            _ => "ply",
        }
    }
}

fn unicode(path: &Path) -> Result<&str> {
    path.to_str().ok_or_else(|| Error::usage(format!("{}: its name is not Unicode; rename it", path.display())))
}

/// The folder that the results of a template have in common: what is before its first variable.
pub(super) fn fixed_folder(template: &Path) -> PathBuf {
    let fixed = |part: &Component| !part.as_os_str().to_string_lossy().contains('{');
    let parts: Vec<_> = template.components().collect();
    let folders = &parts[..parts.len().saturating_sub(1)];
    folders.iter().take_while(|part| fixed(part)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_filled_in() {
        let named = Named { scan: Path::new("/a/scans/x/y/head.v2.STL"), dir: Path::new("x/y") };
        for (template, path) in [
            ("/out/{dir}/{stem}.{faces}.{ext}", "/out/x/y/head.v2.2M.stl"),
            ("out/{stem}_{faces}.ply", "out/head.v2_2M.ply"),
            ("/out/same.ply", "/out/same.ply"),
        ] {
            assert_eq!(named.output(Path::new(template), Target::Faces(2_000_000)).unwrap(), Path::new(path));
        }
        let top = Named { scan: Path::new("scans/a.ply.gz"), dir: Path::new("") };
        for (target, name) in [
            (Target::Ratio(0.07), "/o/a.7pct.ply"),
            (Target::Ratio(0.001), "/o/a.0.1pct.ply"),
            (Target::Faces(1500), "/o/a.1500.ply"),
            (Target::MaxError(0.05), "/o/a.0.05.ply"),
        ] {
            assert_eq!(top.output(Path::new("/o/{dir}/{stem}.{faces}.{ext}"), target).unwrap(), Path::new(name));
        }
    }

    #[test]
    fn what_is_no_variable_is_told() {
        let named = Named { scan: Path::new("a.ply"), dir: Path::new("") };
        let wrong = |text: &str| named.output(Path::new(text), Target::Faces(1)).unwrap_err().to_string();
        assert!(wrong("{stam}.ply").contains("did you mean `{stem}`?"));
        assert!(wrong("{colour}.ply").contains("there are {dir}"));
        assert!(wrong("{stem.ply").contains("without"));
    }

    #[test]
    fn the_fixed_folder_is_what_comes_before_variables() {
        for (template, folder) in [
            ("/a/out/{dir}/{stem}.ply", "/a/out"),
            ("/a/out/x{faces}/b/{stem}.ply", "/a/out"),
            ("/a/small.ply", "/a"),
            ("{stem}.ply", ""),
        ] {
            assert_eq!(fixed_folder(Path::new(template)), Path::new(folder));
        }
    }
}
