//! What a mesh wears: materials and textures as files beside it or within it, and the mesh split where it has seams.

use super::{WholeFile, is_stdout};
use crate::error::{Error, Result};
use crate::mesh::coat::{Coat, Dress};
use crate::mesh::columns::Columns;
use crate::mesh::{Coordinate, IndexedMesh};
use crate::progress::Progress;
use std::fs;
use std::path::{Path, PathBuf};

/// The most that one library or texture may have to be carried along.
const MOST_BYTES: u64 = 1 << 30;

/// A mesh's coat and what it was made of.
#[derive(Debug, Clone, Copy)]
pub struct Clothes<'a> {
    /// Vertices split, and their numbers.
    pub dress: &'a Dress,
    /// Names.
    pub coat: &'a Coat,
    /// Materials by those names.
    pub wardrobe: &'a Wardrobe,
}

/// The materials that a scan names, as its libraries have them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Wardrobe {
    /// Lines of the libraries.
    text: String,
    /// One for each name of the coat.
    pub materials: Vec<Material>,
    /// Textures that are there.
    pub textures: Vec<Texture>,
}

/// A material, as far as glTF has it.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// Its name.
    pub name: String,
    /// Its colour.
    pub colour: [f64; 3],
    /// How opaque it is.
    pub alpha: f64,
    /// The number of its texture.
    pub texture: Option<usize>,
}

/// A picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Texture {
    /// As the library names it.
    pub name: String,
    /// Where it is.
    pub path: PathBuf,
}

impl Texture {
    /// Its type, if it is one that glTF holds.
    pub fn mime(&self) -> Option<&'static str> {
        let extension = self.path.extension()?.to_str()?.to_ascii_lowercase();
        match extension.as_str() {
            "png" => Some("image/png"),
            "jpg" | "jpeg" => Some("image/jpeg"),
            _ => None,
        }
    }

    /// Its bytes.
    pub fn bytes(&self) -> Result<Vec<u8>> {
        fs::read(&self.path).map_err(Error::io(&self.path, "cannot read this texture"))
    }
}

/// A file that can be read as a whole.
fn is_readable(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|m| m.is_file() && m.len() <= MOST_BYTES)
}

impl Wardrobe {
    /// Reads the libraries that a scan names, and looks for their textures. Returns the names of those that are not there,
    /// too.
    pub fn of(coat: &Coat, scan: &Path) -> (Wardrobe, Vec<String>) {
        let folder = scan.parent().unwrap_or(Path::new(""));
        let (mut wardrobe, mut missing) = (Wardrobe::default(), Vec::new());
        for library in &coat.libraries {
            let path = folder.join(library);
            match is_readable(&path).then(|| fs::read(&path)) {
                Some(Ok(bytes)) => {
                    wardrobe.text += &String::from_utf8_lossy(&bytes);
                    wardrobe.text.push('\n');
                }
                _ => missing.push(library.clone()),
            }
        }
        for name in &coat.materials {
            let material = Material { name: name.clone(), colour: [1.0; 3], alpha: 1.0, texture: None };
            wardrobe.materials.push(material);
        }
        let (text, mut current) = (std::mem::take(&mut wardrobe.text), None);
        for line in text.lines() {
            wardrobe.note(line, &mut current, folder, &mut missing);
        }
        wardrobe.text = text;
        (wardrobe, missing)
    }

    fn note(&mut self, line: &str, current: &mut Option<usize>, folder: &Path, missing: &mut Vec<String>) {
        let line = line.trim();
        let (word, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        let numbers = || rest.split_whitespace().map_while(|word| word.parse::<f64>().ok());
        if word == "newmtl" {
            *current = self.materials.iter().position(|m| m.name == rest.trim());
        }
        if let Some(name) = texture_of(line) {
            let known = self.textures.iter().position(|t| t.name == name);
            let path = folder.join(name.replace('\\', "/"));
            let found = known.or_else(|| {
                is_readable(&path).then(|| {
                    self.textures.push(Texture { name: name.into(), path });
                    self.textures.len() - 1
                })
            });
            if found.is_none() && !missing.iter().any(|m| m == name) {
                missing.push(name.into());
            }
            if let (Some(material), "map_Kd") = (current.and_then(|c| self.materials.get_mut(c)), word) {
                material.texture = found;
            }
        }
        let Some(material) = current.and_then(|c| self.materials.get_mut(c)) else { return };
        match word {
            "Kd" => numbers().zip(&mut material.colour).for_each(|(x, c)| *c = x.clamp(0.0, 1.0)),
            "d" => material.alpha = numbers().next().unwrap_or(1.0).clamp(0.0, 1.0),
            "Tr" => material.alpha = 1.0 - numbers().next().unwrap_or(0.0).clamp(0.0, 1.0),
            _ => {}
        }
    }

    /// Puts the materials and textures beside an OBJ that is about to be written, and says what it is to call its library.
    /// Where they are there already, they stay as they are.
    pub(super) fn lay_out(&self, out: &Path, scan: &Path, coat: &Coat, progress: &Progress) -> Result<Option<String>> {
        if self.text.trim().is_empty() {
            return Ok(None);
        }
        let folder = |path: &Path| path.parent().unwrap_or(Path::new("")).to_path_buf();
        let same = |a: &Path, b: &Path| matches!((fs::canonicalize(a), fs::canonicalize(b)), (Ok(a), Ok(b)) if a == b);
        let here = |path: &Path| if path.as_os_str().is_empty() { PathBuf::from(".") } else { path.to_path_buf() };
        let home = same(&here(&folder(out)), &here(&folder(scan)));
        if let (true, [library]) = (is_stdout(out) || home, &coat.libraries[..]) {
            return Ok(Some(library.clone()));
        }
        if is_stdout(out) {
            return Ok(None);
        }
        let stem = out.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut names = Vec::new();
        for texture in &self.textures {
            let name = texture.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let bytes = texture.bytes()?;
            let taken = |name: &str| {
                let path = folder(out).join(name);
                let is = |found: Vec<u8>| found == bytes;
                path.exists() && !(is_readable(&path) && fs::read(&path).is_ok_and(is))
            };
            let name = if taken(&name) { format!("{stem}_{name}") } else { name };
            if !same(&folder(out).join(&name), &texture.path) {
                WholeFile::prepare(&folder(out).join(&name), Some(&texture.path))?.write(&bytes, progress)?;
            }
            names.push((texture.name.as_str(), name));
        }
        let renamed = |line: &str| match texture_of(line).and_then(|t| names.iter().find(|(old, _)| *old == t)) {
            Some((old, new)) => format!("{}{new}\n", line.trim_end().strip_suffix(old).unwrap_or(line)),
            None => format!("{line}\n"),
        };
        let text: String = self.text.lines().map(renamed).collect();
        let name = format!("{stem}.mtl");
        let library = coat.libraries.first().map(|library| folder(scan).join(library));
        WholeFile::prepare(&folder(out).join(&name), library.as_deref())?.write(text.as_bytes(), progress)?;
        Ok(Some(name))
    }
}

/// The file that a line of a library names. Options come before it, and have no place for the names that people give.
fn texture_of(line: &str) -> Option<&str> {
    let line = line.trim();
    let (word, rest) = line.split_once(char::is_whitespace)?;
    let is = word.starts_with("map_") || matches!(word, "bump" | "disp" | "decal" | "norm" | "refl");
    let rest = rest.trim();
    let name = if rest.starts_with('-') { rest.rsplit(char::is_whitespace).next()? } else { rest };
    (is && !name.is_empty()).then_some(name)
}

/// The mesh with a vertex for each wedge, and all that these carry.
pub(super) fn split<S: Coordinate>(
    mesh: &IndexedMesh<S>,
    carried: &Columns,
    dress: &Dress,
) -> (IndexedMesh<S>, Columns) {
    let positions = dress.vertices.iter().map(|v| mesh.positions[*v as usize]).collect();
    let own: Vec<usize> = (0..dress.columns.columns.len())
        .filter(|c| !carried.columns.iter().any(|other| other.name == dress.columns.columns[*c].name))
        .collect();
    let mut columns = Columns { columns: carried.columns.clone(), values: Vec::new() };
    columns.columns.extend(own.iter().map(|c| dress.columns.columns[*c].clone()));
    columns.values.reserve(columns.columns.len() * dress.vertices.len());
    for (wedge, vertex) in dress.vertices.iter().enumerate() {
        if !carried.columns.is_empty() {
            columns.values.extend_from_slice(carried.of(*vertex as usize));
        }
        columns.values.extend(own.iter().map(|c| dress.columns.of(wedge)[*c]));
    }
    (IndexedMesh { positions, faces: dress.corners.clone() }, columns)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_library_is_understood_and_moves_with_its_textures() {
        let folder = tempfile::tempdir().unwrap();
        let (from, to) = (folder.path().join("from"), folder.path().join("to"));
        fs::create_dir_all(from.join("maps")).unwrap();
        fs::create_dir(&to).unwrap();
        fs::write(from.join("maps/bark brown.png"), b"bark").unwrap();
        fs::write(from.join("leaf.png"), b"leaf").unwrap();
        fs::write(to.join("leaf.png"), b"of somebody else").unwrap();
        let text = "newmtl leaf\nKd 0.5 1 0\nd 0.25\nmap_Kd -s 2 2 2 leaf.png\nnewmtl bark\nmap_Kd maps/bark brown.png\nmap_Bump gone.png\n";
        fs::write(from.join("tree.mtl"), text).unwrap();
        let names = |names: &[&str]| names.iter().map(|n| n.to_string()).collect::<Vec<_>>();
        let coat = Coat {
            materials: names(&["bark", "leaf", "moss"]),
            libraries: names(&["tree.mtl", "none.mtl"]),
            ..Coat::default()
        };
        let scan = from.join("tree.obj");
        let (wardrobe, missing) = Wardrobe::of(&coat, &scan);
        assert_eq!(missing, ["none.mtl", "gone.png"]);
        let textures: Vec<_> = wardrobe.materials.iter().map(|m| m.texture).collect();
        assert_eq!(textures, [Some(1), Some(0), None]);
        assert_eq!((wardrobe.materials[1].colour, wardrobe.materials[1].alpha), ([0.5, 1.0, 0.0], 0.25));
        let name = wardrobe.lay_out(&to.join("small.obj"), &scan, &coat, &Progress::default()).unwrap();
        assert_eq!(name.as_deref(), Some("small.mtl"));
        let laid = fs::read_to_string(to.join("small.mtl")).unwrap();
        assert!(
            laid.contains("map_Kd -s 2 2 2 small_leaf.png\n") && laid.contains("map_Kd bark brown.png\n"),
            "{laid}"
        );
        assert_eq!(fs::read(to.join("leaf.png")).unwrap(), b"of somebody else");
        assert_eq!(fs::read(to.join("small_leaf.png")).unwrap(), b"leaf");
        assert_eq!(fs::read(to.join("bark brown.png")).unwrap(), b"bark");
        let one = Coat { libraries: names(&["tree.mtl"]), ..coat };
        let name = wardrobe.lay_out(&from.join("small.obj"), &scan, &one, &Progress::default()).unwrap();
        assert_eq!(name.as_deref(), Some("tree.mtl"), "where it is already, nothing is copied");
        assert!(!from.join("small.mtl").exists());
    }
}
