//! The scans that inputs name: files, folders and patterns, without what is excluded.

use crate::error::{Error, Result};
use globset::{GlobBuilder, GlobMatcher};
use std::path::{Path, PathBuf};
use walkdir::WalkDir;

/// Endings of what can be read, for a folder that is named as a whole.
const READABLE: [&str; 6] = ["ply", "stl", "obj", "off", "glb", "gltf"];

/// Endings that say how a file is packed, not what it is.
pub(super) const PACKED: [&str; 2] = ["gz", "zst"];

/// A scan that was found.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Found {
    /// The scan.
    pub(super) path: PathBuf,
    /// Its folder, below that which was searched.
    pub(super) dir: PathBuf,
    /// Whether a pattern or a folder gave it, not its own name.
    pub(super) searched: bool,
}

/// What `input` names, in the order of names.
pub(super) fn expand(input: &Path, exclude: &Excluded) -> Result<Vec<Found>> {
    if input.is_dir() {
        return walk(input, exclude, |path| {
            let extension = unpacked(path).extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
            extension.is_some_and(|e| READABLE.contains(&e.as_str()))
        });
    }
    if input.exists() || !has_pattern(input) {
        // What does not exist is a scan that fails, not a job that does.
        return Ok(vec![Found { path: input.into(), dir: PathBuf::new(), searched: false }]);
    }
    let (root, pattern) = split(input);
    if !root.is_dir() {
        let what = format!("{}: the folder {} does not exist", input.display(), root.display());
        return Err(Error::usage(what));
    }
    let matcher = matcher(&pattern)?;
    walk(&root, exclude, |path| path.strip_prefix(&root).is_ok_and(|path| matcher.is_match(path)))
}

fn walk(root: &Path, exclude: &Excluded, wanted: impl Fn(&Path) -> bool) -> Result<Vec<Found>> {
    let mut found = Vec::new();
    for entry in WalkDir::new(root).follow_links(true).sort_by_file_name() {
        let entry = entry.map_err(|error| {
            let file = error.path().unwrap_or(root).to_path_buf();
            let source = error.into_io_error().unwrap_or_else(|| std::io::Error::other("its links go in a circle"));
            Error::Io { file, action: "cannot search this folder", source }
        })?;
        let path = entry.path();
        let own = entry.file_name().to_string_lossy().starts_with(".meshmill-");
        if entry.file_type().is_file() && !own && wanted(path) && !exclude.has(path, root) {
            let dir = path.parent().and_then(|folder| folder.strip_prefix(root).ok()).unwrap_or(Path::new(""));
            found.push(Found { path: path.into(), dir: dir.into(), searched: true });
        }
    }
    Ok(found)
}

/// The name of a file without the ending that says how it is packed.
pub(super) fn unpacked(scan: &Path) -> PathBuf {
    match scan.extension() {
        Some(e) if PACKED.iter().any(|packed| e.eq_ignore_ascii_case(packed)) => scan.with_extension(""),
        _ => scan.to_path_buf(),
    }
}

fn has_pattern(path: &Path) -> bool {
    path.to_string_lossy().contains(['*', '?', '[', '{'])
}

/// The folders that a path begins with without a pattern, or though they look like one, and the pattern.
fn split(input: &Path) -> (PathBuf, PathBuf) {
    let mut root = PathBuf::new();
    let mut parts = input.components();
    while let Some(part) = parts.clone().next() {
        let further = root.join(part);
        if has_pattern(Path::new(&part)) && !further.is_dir() {
            break;
        }
        root = further;
        parts.next();
    }
    (root, parts.as_path().into())
}

/// `*` does not go beyond a folder, `**` does.
fn matcher(pattern: &Path) -> Result<GlobMatcher> {
    let glob = GlobBuilder::new(&pattern.to_string_lossy()).literal_separator(true).build();
    glob.map(|glob| glob.compile_matcher()).map_err(|error| Error::usage(format!("{}: {error}", pattern.display())))
}

/// Patterns of what is not meant.
pub(super) struct Excluded {
    matchers: Vec<GlobMatcher>,
    /// The job file's folder.
    folder: PathBuf,
}

impl Excluded {
    /// `patterns`, as they are said in a job file of this folder.
    pub(super) fn new(patterns: &[PathBuf], folder: &Path) -> Result<Excluded> {
        let matchers = patterns.iter().map(|pattern| matcher(pattern)).collect::<Result<_>>()?;
        Ok(Excluded { matchers, folder: folder.into() })
    }

    /// A pattern means a file's name, its path below the folder that is searched, or below the job file's.
    fn has(&self, path: &Path, root: &Path) -> bool {
        let below = |folder: &Path| path.strip_prefix(folder).ok().map(Path::to_path_buf);
        let names = [path.file_name().map(PathBuf::from), below(root), below(&self.folder)];
        self.matchers.iter().any(|matcher| names.iter().flatten().any(|name| matcher.is_match(name)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_folders_and_names_find_what_they_say() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["a.ply", "b.STL", "c.txt", "x/d.ply.gz", "x/y/e.ply", "x/old/f.ply", "odd[1]/g.ply"] {
            std::fs::create_dir_all(at(name).parent().unwrap()).unwrap();
            std::fs::write(at(name), "").unwrap();
        }
        let found = |input: &str, exclude: &[&str]| -> Vec<(String, String)> {
            let exclude: Vec<PathBuf> = exclude.iter().map(PathBuf::from).collect();
            let exclude = Excluded::new(&exclude, folder.path()).unwrap();
            let name = |path: &Path| path.strip_prefix(folder.path()).unwrap_or(path).display().to_string();
            let found = expand(&at(input), &exclude).unwrap();
            found.iter().map(|f| (name(&f.path), f.dir.display().to_string())).collect()
        };
        let names = |input, exclude: &[&str]| found(input, exclude).into_iter().map(|f| f.0).collect::<Vec<_>>();
        assert_eq!(names("", &[]), ["a.ply", "b.STL", "odd[1]/g.ply", "x/d.ply.gz", "x/old/f.ply", "x/y/e.ply"]);
        assert_eq!(names("*.ply", &[]), ["a.ply"]);
        assert_eq!(names("**/*.ply", &["**/old/**", "a.ply"]), ["odd[1]/g.ply", "x/y/e.ply"]);
        assert_eq!(names("x/*/?.ply", &["x/y/*"]), ["x/old/f.ply"]);
        assert_eq!(found("x/**/e.ply", &[]), [("x/y/e.ply".into(), "y".into())]);
        assert_eq!(found("odd[1]/*.ply", &[]), [("odd[1]/g.ply".into(), "".into())]);
        assert_eq!(found("a.ply", &["a.ply"]), [("a.ply".into(), "".into())]);
        assert_eq!(names("missing.ply", &[]), ["missing.ply"]);
        assert!(expand(&at("nowhere/*.ply"), &Excluded::new(&[], folder.path()).unwrap()).is_err());
        assert!(Excluded::new(&["a[".into()], folder.path()).is_err());
    }
}
