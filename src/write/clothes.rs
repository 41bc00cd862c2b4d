//! What a mesh wears: materials and textures as files beside it or within it, and the mesh split where it has seams.

use super::{Sink, WholeFile, is_stdout};
use crate::error::{Error, Result};
use crate::mesh::coat::{Bytes, Coat, Dress};
use crate::mesh::columns::Columns;
use crate::mesh::{Coordinate, IndexedMesh};
use crate::progress::Progress;
use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// The most that one library may have to be carried along.
const MOST_BYTES: u64 = 1 << 26;

/// Bytes of a texture that are copied at a time.
const PIECE_BYTES: usize = 1 << 16;

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
#[derive(Debug, Clone, PartialEq)]
pub struct Texture {
    /// As the library names it.
    pub name: String,
    /// Where it is.
    pub place: Bytes,
}

impl Texture {
    /// Its type, if it is one that glTF holds: by what it begins with, and by its name where that tells nothing.
    pub fn mime(&self) -> Option<&'static str> {
        let mut head = [0; 8];
        let length = self.length().ok()?.min(8) as usize;
        self.read(&mut head[..length], 0).ok()?;
        match head {
            [0x89, b'P', b'N', b'G', ..] => Some("image/png"),
            [0xff, 0xd8, 0xff, ..] => Some("image/jpeg"),
            [b'R', b'I', b'F', b'F', ..] | [0xab, b'K', b'T', b'X', ..] | [b'D', b'D', b'S', ..] => None,
            _ => {
                let name = self.path().extension()?.to_str()?.to_ascii_lowercase();
                let known = [("png", "image/png"), ("jpg", "image/jpeg"), ("jpeg", "image/jpeg")];
                known.into_iter().find(|(extension, _)| *extension == name).map(|(_, mime)| mime)
            }
        }
    }

    fn path(&self) -> &Path {
        if let Bytes::File(path) = &self.place { path } else { Path::new(&self.name) }
    }

    /// How many bytes it has.
    pub fn length(&self) -> Result<u64> {
        match &self.place {
            Bytes::File(path) => fs::metadata(path).map(|m| m.len()).map_err(self.unreadable()),
            Bytes::Part { length, .. } => Ok(*length),
        }
    }

    fn unreadable(&self) -> impl FnOnce(std::io::Error) -> Error {
        Error::io(self.path(), "cannot read this texture")
    }

    fn read(&self, bytes: &mut [u8], from: u64) -> Result<()> {
        match &self.place {
            Bytes::File(path) => File::open(path).and_then(|file| file.read_exact_at(bytes, from)),
            Bytes::Part { file, offset, length } if from + bytes.len() as u64 <= *length => {
                file.read_exact_at(bytes, offset + from)
            }
            Bytes::Part { .. } => Err(std::io::ErrorKind::UnexpectedEof.into()),
        }
        .map_err(self.unreadable())
    }

    /// Hands over all of it, a piece at a time, each with where it begins, until one is refused.
    pub fn pieces(&self, take: &mut dyn FnMut(&[u8], u64) -> Result<bool>) -> Result<()> {
        let (length, mut done) = (self.length()?, 0);
        let mut piece = vec![0; PIECE_BYTES.min(length as usize)];
        while done < length {
            let some = (length - done).min(PIECE_BYTES as u64) as usize;
            self.read(&mut piece[..some], done)?;
            if !take(&piece[..some], done)? {
                break;
            }
            done += some as u64;
        }
        Ok(())
    }

    /// Whether a file is the same, byte for byte.
    fn is_in(&self, path: &Path) -> bool {
        let Ok(length) = self.length() else { return false };
        let Ok(file) = File::open(path) else { return false };
        if !file.metadata().is_ok_and(|m| m.is_file() && m.len() == length) {
            return false;
        }
        let (mut other, mut same) = (Vec::new(), true);
        let compared = self.pieces(&mut |piece, from| {
            other.resize(piece.len(), 0);
            same = file.read_exact_at(&mut other, from).is_ok() && other == piece;
            Ok(same)
        });
        compared.is_ok() && same
    }

    /// The name of its file.
    pub(super) fn file_name(&self) -> String {
        let path = self.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match (path.extension(), self.mime()) {
            (None, Some("image/png")) => name + ".png",
            (None, Some("image/jpeg")) => name + ".jpg",
            _ => name,
        }
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
        wardrobe.take_looks(coat);
        missing.extend(coat.lost.iter().cloned());
        (wardrobe, missing)
    }

    /// Takes what the scan itself says of its materials, and says it as a library would.
    fn take_looks(&mut self, coat: &Coat) {
        let textures = coat.pictures.iter().map(|p| Texture { name: p.name.clone(), place: p.place.clone() });
        let first = self.textures.len();
        self.textures.extend(textures);
        for (material, look) in self.materials.iter_mut().zip(&coat.looks) {
            (material.colour, material.alpha) = (look.colour, look.alpha);
            material.texture = look.picture.map(|picture| first + picture);
            let [r, g, b] = look.colour.map(|x| x as f32);
            self.text += &format!("newmtl {}\nKd {r} {g} {b}\nd {}\n", material.name, look.alpha as f32);
            if let Some(texture) = material.texture {
                self.text += &format!("map_Kd {}\n", self.textures[texture].name);
            }
        }
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
                path.is_file().then(|| {
                    self.textures.push(Texture { name: name.into(), place: Bytes::File(path) });
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
        let names = self.lay_out_textures(out, progress)?;
        let renamed = |line: &str| match texture_of(line)
            .and_then(|t| self.textures.iter().position(|texture| texture.name == t))
        {
            Some(i) => {
                let before = line.trim_end().strip_suffix(self.textures[i].name.as_str()).unwrap_or(line);
                format!("{before}{}\n", names[i])
            }
            None => format!("{line}\n"),
        };
        let text: String = self.text.lines().map(renamed).collect();
        let name = format!("{stem}.mtl");
        let library = coat.libraries.first().map(|library| folder(scan).join(library));
        WholeFile::prepare(&folder(out).join(&name), library.as_deref())?.write(text.as_bytes(), progress)?;
        Ok(Some(name))
    }

    /// The textures that a PLY is to name, which has no materials: if there is one for all faces, or one for each number
    /// that faces have for it.
    pub fn as_ply(&self, coat: &Coat) -> Option<Vec<usize>> {
        let textures: Option<Vec<usize>> = self.materials.iter().map(|material| material.texture).collect();
        let numbered = coat.face_columns.iter().any(|column| column.name == "texnumber");
        textures.filter(|all| all.len() == 1 || numbered && !all.is_empty())
    }

    /// Puts the textures beside a file that is about to be written; the names that they have there.
    pub(super) fn lay_out_textures(&self, out: &Path, progress: &Progress) -> Result<Vec<String>> {
        let folder = out.parent().unwrap_or(Path::new(""));
        let stem = out.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut names: Vec<String> = Vec::new();
        for texture in &self.textures {
            let name = texture.file_name();
            let other = |name: &String| {
                names.contains(name) || folder.join(name).exists() && !texture.is_in(&folder.join(name))
            };
            let name = if other(&name) { format!("{stem}_{name}") } else { name };
            let path = folder.join(&name);
            if !texture.is_in(&path) {
                let own = if let Bytes::File(own) = &texture.place { Some(own.as_path()) } else { None };
                let copy = |sink: &mut Sink<'_, &File>| texture.pieces(&mut |piece, _| sink.put(piece).map(|()| true));
                WholeFile::prepare(&path, own)?.write_by(progress, copy)?;
            }
            names.push(name);
        }
        Ok(names)
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
