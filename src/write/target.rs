//! The target of a run: checked before the work, replaced after it, in one step.

use super::clothes::split;
use super::encode::{Contents, Header, encode};
use super::{Clothes, Format, Load, Sink};
use crate::error::{Error, Result};
use crate::mesh::columns::Columns;
use crate::mesh::{Coordinate, Frame, IndexedMesh};
use crate::progress::{Progress, Stage};
use std::ffi::OsStr;
use std::fs::{self, File, Metadata, OpenOptions, Permissions};
use std::io;
use std::os::fd::AsFd;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

const PREFIX: &str = ".meshmill-";
const SUFFIX: &str = ".tmp";

/// A mesh to be written, to a file or to standard output.
#[derive(Debug)]
pub struct Target {
    format: Format,
    whole: WholeFile,
}

/// The same for a file of any kind.
#[derive(Debug)]
pub struct WholeFile {
    path: PathBuf,
    place: Place,
}

#[derive(Debug)]
enum Place {
    /// A locked temporary file in the target's folder, which becomes the target when it is complete and vanishes when it
    /// is dropped before.
    Folder {
        folder: PathBuf,
        temporary: NamedTempFile,
    },
    Stdout,
}

/// Whether a path stands for standard output.
pub fn is_stdout(path: &Path) -> bool {
    path == Path::new("-")
}

impl Target {
    /// [`prepare_as`](Self::prepare_as), in the format that the extension says.
    pub fn prepare(out: &Path, input: Option<&Path>) -> Result<Target> {
        Self::prepare_as(out, Format::of(out)?, input)
    }

    /// Checks all that can be checked before any work: the folder, that `out` is not a folder or anything
    /// else that cannot be replaced, that it is not `input` under another name; and that a file can be made there.
    /// Temporary files that killed runs left in the folder are removed.
    pub fn prepare_as(out: &Path, format: Format, input: Option<&Path>) -> Result<Target> {
        Ok(Target { format, whole: WholeFile::prepare(out, input)? })
    }

    /// Refuses to replace a further input.
    pub fn check_is_not(&self, input: &Path) -> Result<()> {
        self.whole.check_is_not(input)
    }

    /// What will be written.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Where it will be, symbolic links followed.
    pub fn path(&self) -> &Path {
        &self.whole.path
    }

    /// Whether coordinates in doubles would be rounded to floats.
    pub fn loses_doubles(&self) -> bool {
        self.format == Format::Stl
    }

    /// Writes `mesh` in the file's units and puts it in the target's place; the number of bytes.
    pub fn write_mesh<S: Coordinate>(self, mesh: &IndexedMesh<S>, frame: Frame, progress: &Progress) -> Result<u64> {
        let nothing = Columns::default();
        self.write_carrying(mesh, frame, Load { vertices: &nothing, faces: &nothing, clothes: None }, progress)
    }

    /// The same with what its vertices carry, and what it wears, as far as the format holds it.
    pub fn write_carrying<S: Coordinate>(
        self,
        mesh: &IndexedMesh<S>,
        frame: Frame,
        Load { vertices: carried, faces: of_faces, clothes }: Load<'_>,
        progress: &Progress,
    ) -> Result<u64> {
        let (mut library, mut textures) = (None, Vec::new());
        let apart;
        let (mut mesh, mut carried) = (mesh, carried);
        if let Some((Clothes { dress, coat, wardrobe }, scan)) = clothes {
            if self.format == Format::Obj {
                library = wardrobe.lay_out(&self.whole.path, scan, coat, progress)?;
            } else if dress.splits(self.format == Format::Stl) {
                if let Some(order) =
                    wardrobe.as_ply(coat).filter(|_| self.format.is_ply() && !is_stdout(&self.whole.path))
                {
                    let names = wardrobe.lay_out_textures(&self.whole.path, progress)?;
                    textures = order.into_iter().map(|texture| names[texture].clone()).collect();
                }
                apart = split(mesh, carried, dress);
                (mesh, carried) = (&apart.0, &apart.1);
            }
        }
        let header = Header {
            format: self.format,
            double: S::DOUBLE,
            vertices: mesh.positions.len() as u64,
            faces: mesh.faces.len() as u64,
        };
        progress.begin(Stage::Write, header.element_bytes());
        let path = self.whole.path.clone();
        let clothes = clothes.map(|(clothes, _)| clothes);
        let contents =
            Contents { mesh, frame, carried, of_faces, clothes, library: library.as_deref(), textures: &textures };
        self.write_by(progress, |sink| encode(&contents, &header, &path, sink))
    }

    /// Has `fill` write the contents, then puts them in the target's place; the number of bytes.
    pub(crate) fn write_by(
        self,
        progress: &Progress,
        fill: impl FnOnce(&mut Sink<'_, &File>) -> Result<()>,
    ) -> Result<u64> {
        self.whole.write_by(progress, fill)
    }
}

impl WholeFile {
    /// Checks all that can be checked before any work: the folder, that `out` is not a folder or anything else that cannot
    /// be replaced, that it is not `input` under another name; and that a file can be made there. Temporary files that
    /// killed runs left in the folder are removed.
    pub fn prepare(out: &Path, input: Option<&Path>) -> Result<WholeFile> {
        if is_stdout(out) {
            return Ok(WholeFile { path: out.into(), place: Place::Stdout });
        }
        let path = resolve(out)?;
        if let Ok(existing) = fs::metadata(&path) {
            check_replaceable(out, &existing)?;
            if let Some(input) = input {
                check_not_input(out, &existing, input)?;
            }
        }
        let folder = folder_of(&path)?;
        sweep(&folder);
        let temporary = create_locked(&folder)?;
        Ok(WholeFile { path, place: Place::Folder { folder, temporary } })
    }

    /// Refuses to replace a further input.
    pub fn check_is_not(&self, input: &Path) -> Result<()> {
        if matches!(self.place, Place::Stdout) {
            return Ok(());
        }
        match fs::metadata(&self.path) {
            Ok(existing) => check_not_input(&self.path, &existing, input),
            Err(_) => Ok(()),
        }
    }

    /// Writes these bytes and puts them in place.
    pub fn write(self, bytes: &[u8], progress: &Progress) -> Result<u64> {
        self.write_by(progress, |sink| sink.put(bytes))
    }

    /// Has `fill` write the contents, then puts them in place; the number of bytes.
    pub(crate) fn write_by(
        self,
        progress: &Progress,
        fill: impl FnOnce(&mut Sink<'_, &File>) -> Result<()>,
    ) -> Result<u64> {
        let Place::Folder { folder, temporary } = self.place else { return to_stdout(&self.path, progress, fill) };
        let file = temporary.as_file();
        let mut sink = Sink::new(file, &self.path, progress);
        fill(&mut sink)?;
        let bytes = sink.finish()?;
        file.sync_all().map_err(Error::io(&self.path, "cannot write"))?;
        progress.check()?;
        let replace = Error::io(&self.path, "cannot put the finished file in place");
        temporary.persist(&self.path).map_err(|e| replace(e.error))?;
        // The file is whole and in place; some file systems cannot sync a folder, which is no reason to call it failed.
        let _ = File::open(&folder).and_then(|folder| folder.sync_all());
        Ok(bytes)
    }
}

/// Has `fill` write to standard output.
fn to_stdout(path: &Path, progress: &Progress, fill: impl FnOnce(&mut Sink<'_, &File>) -> Result<()>) -> Result<u64> {
    // A handle of our own on the descriptor: bytes are gathered by the sink already.
    let stdout = std::io::stdout().as_fd().try_clone_to_owned().map_err(Error::io(path, "cannot write"))?;
    let file = File::from(stdout);
    let mut sink = Sink::new(&file, path, progress);
    fill(&mut sink)?;
    sink.finish()
}

/// Where `out` leads: a symbolic link is written through, as any program would, not replaced.
fn resolve(out: &Path) -> Result<PathBuf> {
    let is_link = fs::symlink_metadata(out).is_ok_and(|m| m.is_symlink());
    let path = if is_link {
        fs::canonicalize(out).map_err(Error::io(out, "cannot follow this symbolic link"))?
    } else {
        out.to_path_buf()
    };
    if path.file_name().is_none() || out.as_os_str().as_encoded_bytes().ends_with(b"/") {
        return Err(Error::usage(format!("{}: names a folder, not a file to write", out.display())));
    }
    Ok(path)
}

fn check_replaceable(out: &Path, existing: &Metadata) -> Result<()> {
    let found = if existing.is_dir() {
        "a folder"
    } else if existing.is_file() {
        return Ok(());
    } else {
        "not a regular file"
    };
    Err(Error::usage(format!("{}: is {found}, and only a file can be replaced", out.display())))
}

fn check_not_input(out: &Path, existing: &Metadata, input: &Path) -> Result<()> {
    let same = fs::metadata(input).is_ok_and(|i| (i.dev(), i.ino()) == (existing.dev(), existing.ino()));
    if same {
        let (out, input) = (out.display(), input.display());
        return Err(Error::usage(format!("{out}: is the input {input} itself; write to another file")));
    }
    Ok(())
}

fn folder_of(path: &Path) -> Result<PathBuf> {
    let folder = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let refuse = Error::io(folder, "cannot write into this folder");
    match fs::metadata(folder) {
        Ok(found) if found.is_dir() => Ok(folder.to_path_buf()),
        Ok(_) => Err(refuse(io::ErrorKind::NotADirectory.into())),
        Err(error) => Err(refuse(error)),
    }
}

/// Makes and locks the temporary file. A sweep of another run may see the file before its lock, but removes it only while
/// it holds the lock itself: once we have it, either the name is gone, and another file is made, or it is ours.
fn create_locked(folder: &Path) -> Result<NamedTempFile> {
    loop {
        let file = tempfile::Builder::new()
            .prefix(PREFIX)
            .suffix(SUFFIX)
            .rand_bytes(10)
            .permissions(Permissions::from_mode(0o666))
            .tempfile_in(folder)
            .map_err(Error::io(folder, "cannot write into this folder"))?;
        // Where locks do not exist, nobody gets one, and so nobody sweeps.
        let locked = file.as_file().lock().is_ok();
        if !locked || file.as_file().metadata().is_ok_and(|m| m.nlink() > 0) {
            return Ok(file);
        }
    }
}

/// Removes the temporary files of runs that no longer live: those whose lock can be had. Whatever fails, stays.
pub fn sweep(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        if is_temporary(&entry.file_name()) && entry.file_type().is_ok_and(|t| t.is_file()) {
            remove_if_stale(&entry.path());
        }
    }
}

fn remove_if_stale(path: &Path) {
    // Opened for writing, since some network file systems lock nothing else.
    let Ok(file) = OpenOptions::new().write(true).open(path) else { return };
    if file.try_lock().is_ok() {
        let _ = fs::remove_file(path);
    }
}

fn is_temporary(name: &OsStr) -> bool {
    name.to_str().is_some_and(|n| n.starts_with(PREFIX) && n.ends_with(SUFFIX))
}
