//! Scratch files: space on disk for what memory does not hold.
//!
//! They have no name (unlinked, or never linked), so that nothing is left of them however a run ends.

use crate::budget::{MIB, Size};
use crate::error::{Error, Result};
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// What all scratch files of a run may hold together when nothing is said: more than a scan of a billion faces takes, and
/// a bound on what a small compressed file can do to a disk.
pub const DEFAULT_QUOTA: Size = Size(256 << 30);

/// The folder in which a run's scratch files are made, what they may take, and how much they took.
#[derive(Debug, Clone)]
pub struct Scratch {
    folder: Arc<PathBuf>,
    quota_bytes: u64,
    memory_bytes: u64,
    counts: Arc<Counts>,
}

#[derive(Debug, Default)]
struct Counts {
    written: AtomicU64,
    held: AtomicU64,
    peak: AtomicU64,
}

impl Scratch {
    /// Scratch files will be made in `folder`; nothing is touched yet.
    pub fn in_folder(folder: &Path) -> Scratch {
        // The folder that a bare file name is in has the empty path.
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        Scratch {
            folder: Arc::new(folder.to_path_buf()),
            quota_bytes: DEFAULT_QUOTA.0,
            memory_bytes: 512 * MIB,
            counts: Arc::default(),
        }
    }

    /// With so many bytes for all files together.
    pub fn with_quota(self, bytes: u64) -> Scratch {
        Scratch { quota_bytes: bytes, ..self }
    }

    /// With so many bytes of memory for those that fill it.
    pub fn with_memory(self, bytes: u64) -> Scratch {
        Scratch { memory_bytes: bytes, ..self }
    }

    /// Bytes of memory that who fills it may use.
    pub fn memory(&self) -> u64 {
        self.memory_bytes
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// A new, empty file.
    pub fn file(&self) -> Result<ScratchFile> {
        let file = tempfile::tempfile_in(&*self.folder)
            .map_err(Error::io(&self.folder, "cannot make a scratch file in this folder"))?;
        Ok(ScratchFile { file, length: AtomicU64::new(0), scratch: self.clone() })
    }

    /// Bytes that the quota leaves now.
    pub fn left(&self) -> u64 {
        self.quota_bytes.saturating_sub(self.counts.held.load(Relaxed))
    }

    /// The most bytes that scratch files have held at one time.
    pub fn bytes(&self) -> u64 {
        self.counts.peak.load(Relaxed)
    }

    /// Bytes written in all, whether or not over others.
    pub fn written(&self) -> u64 {
        self.counts.written.load(Relaxed)
    }
}

/// A file without a name. Threads write and read it side by side, each at its own offsets.
#[derive(Debug)]
pub struct ScratchFile {
    file: File,
    length: AtomicU64,
    scratch: Scratch,
}

impl ScratchFile {
    /// Writes all of `bytes` at `offset`.
    pub fn write_all_at(&self, bytes: &[u8], offset: u64) -> Result<()> {
        let end = offset + bytes.len() as u64;
        self.grow(end.saturating_sub(self.length.fetch_max(end, Relaxed)))?;
        self.write(bytes, offset)
    }

    /// Writes all of `bytes` behind what there is, whoever else does so at the same time; returns where that was.
    pub fn append(&self, bytes: &[u8]) -> Result<u64> {
        let length = bytes.len() as u64;
        let offset = self.length.fetch_add(length, Relaxed);
        self.grow(length)?;
        self.write(bytes, offset)?;
        Ok(offset)
    }

    /// Counts bytes that the file is to hold beside those that it held.
    fn grow(&self, bytes: u64) -> Result<()> {
        let counts = &self.scratch.counts;
        let held = counts.held.fetch_add(bytes, Relaxed) + bytes;
        if bytes > 0 && held > self.scratch.quota_bytes {
            let what = format!("more than the quota of {} is needed", Size(self.scratch.quota_bytes));
            return Err(self.refuse(std::io::Error::new(std::io::ErrorKind::QuotaExceeded, what)));
        }
        counts.peak.fetch_max(held, Relaxed);
        Ok(())
    }

    fn write(&self, bytes: &[u8], offset: u64) -> Result<()> {
        self.file.write_all_at(bytes, offset).map_err(|e| self.refuse(e))?;
        self.scratch.counts.written.fetch_add(bytes.len() as u64, Relaxed);
        Ok(())
    }

    fn refuse(&self, error: std::io::Error) -> Error {
        Error::io(&self.scratch.folder, "cannot write a scratch file in this folder")(error)
    }

    /// Fills `bytes` from `offset`.
    pub fn read_exact_at(&self, bytes: &mut [u8], offset: u64) -> Result<()> {
        self.file
            .read_exact_at(bytes, offset)
            .map_err(Error::io(&self.scratch.folder, "cannot read a scratch file in this folder"))
    }

    /// The end of what was written.
    pub fn length(&self) -> u64 {
        self.length.load(Relaxed)
    }

    /// The file itself, for mapping.
    pub fn as_file(&self) -> &File {
        &self.file
    }
}

impl Drop for ScratchFile {
    fn drop(&mut self) {
        self.scratch.counts.held.fetch_sub(*self.length.get_mut(), Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_share_a_file_and_the_counts_add_up() {
        let folder = tempfile::tempdir().unwrap();
        let scratch = Scratch::in_folder(folder.path());
        let file = scratch.file().unwrap();
        std::thread::scope(|threads| {
            for part in 0..4u8 {
                let file = &file;
                threads.spawn(move || {
                    for piece in 0..16 {
                        file.write_all_at(&[part; 100], (u64::from(part) + 4 * piece) * 100).unwrap();
                    }
                });
            }
        });
        let mut bytes = vec![0; 6400];
        file.read_exact_at(&mut bytes, 0).unwrap();
        assert!(bytes.chunks(100).enumerate().all(|(i, piece)| piece == [(i % 4) as u8; 100]));
        assert_eq!((file.length(), scratch.bytes(), scratch.written()), (6400, 6400, 6400));

        let second = scratch.file().unwrap();
        second.write_all_at(&[1; 50], 0).unwrap();
        second.write_all_at(&[2; 50], 0).unwrap();
        assert_eq!((scratch.bytes(), scratch.written()), (6450, 6500));
        drop((file, second));
        let third = scratch.file().unwrap();
        third.write_all_at(&[1; 60], 0).unwrap();
        assert_eq!(scratch.bytes(), 6450, "space given back is not counted twice");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "the files have no names");
    }

    #[test]
    fn threads_append_to_a_file_and_each_finds_its_own_again() {
        let folder = tempfile::tempdir().unwrap();
        let scratch = Scratch::in_folder(folder.path());
        let file = scratch.file().unwrap();
        file.write_all_at(&[9; 50], 0).unwrap();
        std::thread::scope(|threads| {
            for part in 0..4u8 {
                let file = &file;
                threads.spawn(move || {
                    for length in 1..40 {
                        let bytes = vec![part; length];
                        let (at, mut found) = (file.append(&bytes).unwrap(), vec![7; length]);
                        file.read_exact_at(&mut found, at).unwrap();
                        assert!(at >= 50 && found == bytes);
                    }
                });
            }
        });
        assert_eq!((file.length(), scratch.bytes(), scratch.written()), (50 + 3120, 50 + 3120, 50 + 3120));
    }

    #[test]
    fn a_quota_is_kept_by_all_files_together() {
        let folder = tempfile::tempdir().unwrap();
        let scratch = Scratch::in_folder(folder.path()).with_quota(1000);
        let (one, two) = (scratch.file().unwrap(), scratch.file().unwrap());
        one.write_all_at(&[1; 600], 0).unwrap();
        assert_eq!(scratch.left(), 400);
        two.write_all_at(&[2; 400], 0).unwrap();
        one.write_all_at(&[3; 600], 0).unwrap();
        let error = two.write_all_at(&[2; 1], 400).unwrap_err();
        assert!(error.to_string().ends_with("more than the quota of 1MiB is needed"), "{error}");
        drop(one);
        assert_eq!(scratch.left(), 599);
        let three = scratch.file().unwrap();
        three.write_all_at(&[2; 500], 0).unwrap();
    }

    #[test]
    fn errors_name_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let gone = folder.path().join("gone");
        let error = Scratch::in_folder(&gone).file().unwrap_err();
        assert_eq!((error.code(), error.file()), ("io", Some(gone.as_path())));
        let file = Scratch::in_folder(folder.path()).file().unwrap();
        let error = file.read_exact_at(&mut [0; 4], 0).unwrap_err();
        assert_eq!(error.file(), Some(folder.path()));
    }
}
