//! The mapped input: a file opened for reading, seen through windows that are populated and then dropped.
//!
//! This is the only file of the crate with `unsafe` in it. A [`Window`] is made resident before anyone looks into it and
//! is unmapped when it is dropped, so what is resident is what is in flight, however large the file.
#![allow(unsafe_code)]

use crate::error::{Error, Result};
use crate::mesh::coat::Bytes;
use crate::scratch::ScratchFile;
use memmap2::{Mmap, MmapOptions};
use std::fs::File;
use std::ops::Deref;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The length of a window: long enough that mapping it costs nothing beside decoding it, short enough that a handful in
/// flight is a few mebibytes.
pub(super) const WINDOW_BYTES: usize = 1 << 20;

/// An input file and the size it had when it was opened.
#[derive(Debug)]
pub(super) struct Input {
    path: PathBuf,
    file: File,
    len: u64,
    /// What `file` is a handle on, where it is not a file of the user's.
    unpacked: Option<ScratchFile>,
}

impl Input {
    /// What was unpacked from the file at `path`, which errors name.
    pub fn unpacked(path: &Path, unpacked: ScratchFile) -> Result<Self> {
        let file = unpacked.as_file().try_clone().map_err(Error::io(path, "cannot read what was unpacked"))?;
        let len = unpacked.length();
        if len == 0 {
            return Err(Error::input(path, "the file is empty"));
        }
        Ok(Input { path: path.into(), file, len, unpacked: Some(unpacked) })
    }

    /// Opens a regular, non-empty file. A fifo or device is refused before it is opened, since opening may block.
    pub fn open(path: &Path) -> Result<Self> {
        refuse_unless_regular(path, &std::fs::metadata(path).map_err(Error::io(path, "cannot open"))?)?;
        let file = File::open(path).map_err(Error::io(path, "cannot open"))?;
        let metadata = file.metadata().map_err(Error::io(path, "cannot open"))?;
        refuse_unless_regular(path, &metadata)?;
        if metadata.len() == 0 {
            return Err(Error::input(path, "the file is empty"));
        }
        Ok(Input { path: path.into(), file, len: metadata.len(), unpacked: None })
    }

    /// Where the file is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether its bytes are in scratch, not at [`path`](Self::path): offsets then mean nothing to the user.
    pub fn is_unpacked(&self) -> bool {
        self.unpacked.is_some()
    }

    /// Some of its bytes, for whoever reads them later.
    pub fn part(&self, offset: u64, length: u64) -> Result<Bytes> {
        let file = self.file.try_clone().map_err(Error::io(&self.path, "cannot read"))?;
        Ok(Bytes::Part { file: Arc::new(file), offset, length })
    }

    /// Its size when it was opened.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// Maps `len` bytes from `from` on, which must lie within the file, and makes them resident.
    pub fn window(&self, from: u64, len: usize) -> Result<Window> {
        debug_assert!(from + len as u64 <= self.len);
        self.check_unchanged()?;
        // SAFETY: a shared read-only map of a regular file of at least `from + len` bytes, as was just checked.
        //
        // What the type system cannot rule out is another process that writes to the scan or cuts it while it is mapped.
        // Overwritten bytes: the map is only ever looked at as `u8`, for which every value is valid, by decoders that
        // copy a number out and then check the copy, so the worst is a wrong number or an error about it. Cut bytes: a
        // read beyond the new end would raise SIGBUS. The pages are populated at once, below, by a call that reports such
        // an end as an error, and the size is checked before each window, which leaves a cut within the milliseconds
        // between populating a window and decoding it. Nothing short of copying the file closes that gap; it ends the
        // process before any target is renamed into place, so no half-written result can come of it.
        let map = unsafe { MmapOptions::new().offset(from).len(len).map(&self.file) }
            .map_err(Error::io(&self.path, "cannot map"))?;
        self.populate(&map)?;
        Ok(Window { map, from })
    }

    #[cfg(target_os = "linux")]
    fn populate(&self, map: &Mmap) -> Result<()> {
        match map.advise(memmap2::Advice::PopulateRead) {
            Ok(()) => Ok(()),
            // Before Linux 5.14 the advice is unknown: pages then come one by one as they are touched.
            Err(e) if e.kind() == std::io::ErrorKind::InvalidInput => Ok(()),
            Err(e) => {
                self.check_unchanged()?;
                Err(Error::io(&self.path, "cannot read")(e))
            }
        }
    }

    #[cfg(not(target_os = "linux"))]
    fn populate(&self, _: &Mmap) -> Result<()> {
        Ok(())
    }

    /// Reads exactly `buffer.len()` bytes from `from` on, past the map: for looking here and there without making pages
    /// resident.
    pub fn read_at(&self, buffer: &mut [u8], from: u64) -> Result<()> {
        self.check_unchanged()?;
        self.file.read_exact_at(buffer, from).map_err(Error::io(&self.path, "cannot read"))
    }

    fn check_unchanged(&self) -> Result<()> {
        let now = self.file.metadata().map_err(Error::io(&self.path, "cannot read"))?.len();
        if now == self.len {
            return Ok(());
        }
        Err(Error::input(&self.path, format!("had {} bytes when it was opened, but has {now} now", self.len)))
    }
}

fn refuse_unless_regular(path: &Path, metadata: &std::fs::Metadata) -> Result<()> {
    if metadata.is_dir() {
        return Err(Error::input(path, "is a folder, not a file"));
    }
    if !metadata.is_file() {
        return Err(Error::input(path, "is a pipe or device: only a regular file can be mapped"));
    }
    Ok(())
}

/// Some bytes of the file, resident from its making until it is dropped.
#[derive(Debug)]
pub(super) struct Window {
    map: Mmap,
    from: u64,
}

impl Window {
    /// Where in the file the window begins.
    pub fn from(&self) -> u64 {
        self.from
    }
}

impl Deref for Window {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.map
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_shows_the_bytes_of_its_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bytes");
        let bytes: Vec<u8> = (0..20_000u32).map(|i| (i % 251) as u8).collect();
        std::fs::write(&path, &bytes).unwrap();
        let input = Input::open(&path).unwrap();
        let window = input.window(4_099, 9_000).unwrap();
        assert_eq!(&window[..], &bytes[4_099..13_099]);
        let mut few = [0; 7];
        input.read_at(&mut few, 19_993).unwrap();
        assert_eq!(few, bytes[19_993..]);
    }

    #[test]
    fn a_file_that_is_cut_while_open_is_an_error_and_not_a_signal() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bytes");
        std::fs::write(&path, vec![7; 100_000]).unwrap();
        let input = Input::open(&path).unwrap();
        File::options().write(true).open(&path).unwrap().set_len(5_000).unwrap();
        let error = input.window(0, 100_000).unwrap_err().to_string();
        assert!(error.ends_with("had 100000 bytes when it was opened, but has 5000 now"), "{error}");
        assert!(input.read_at(&mut [0; 8], 50_000).is_err());
    }

    #[test]
    fn what_is_no_regular_file_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        assert!(Input::open(folder.path()).unwrap_err().to_string().ends_with("is a folder, not a file"));
        assert!(Input::open(Path::new("/dev/null")).unwrap_err().to_string().contains("pipe or device"));
        let empty = folder.path().join("empty");
        std::fs::write(&empty, []).unwrap();
        assert!(Input::open(&empty).unwrap_err().to_string().ends_with("the file is empty"));
        let missing = Input::open(&folder.path().join("missing")).unwrap_err();
        assert_eq!(missing.code(), "io");
    }
}
