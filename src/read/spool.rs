//! What cannot be mapped where it is: compressed files, and standard input. It is unpacked into scratch, and mapped there.
//!
//! Disk: what it unpacks to, within the quota of [`Scratch`]. Memory: a mebibyte of buffers, and of a `.zst` the window
//! that its packer chose, at most half of what [`Scratch::memory`] allows.

use super::map::Input;
use crate::error::{Error, Result};
use crate::progress::{Progress, Stage};
use crate::scratch::Scratch;
use flate2::bufread::MultiGzDecoder;
use serde::Serialize;
use std::fmt;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::path::Path;

/// Bytes read and written at a time.
const PIECE_BYTES: usize = 256 << 10;

/// The bytes that tell how a file is compressed.
const MAGIC_BYTES: usize = 4;

/// How a file is compressed, told by its content.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Compression {
    /// gzip, in one member or many.
    Gzip,
    /// Zstandard, in one frame or many.
    Zstd,
}

impl fmt::Display for Compression {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Compression::Gzip => "gzip",
            Compression::Zstd => "zstd",
        })
    }
}

impl Compression {
    fn of(magic: &[u8]) -> Option<Compression> {
        match magic {
            [0x1f, 0x8b, ..] => Some(Compression::Gzip),
            [0x28, 0xb5, 0x2f, 0xfd, ..] => Some(Compression::Zstd),
            _ => None,
        }
    }
}

/// The name of standard input.
pub const STDIN: &str = "-";

/// Opens a file, or standard input, and unpacks it where that is needed.
pub(super) fn open(
    path: &Path,
    scratch: Option<&Scratch>,
    progress: &Progress,
) -> Result<(Input, Option<Compression>)> {
    let is_stdin = path == Path::new(STDIN);
    if is_stdin {
        // A file that was redirected is mapped like any other.
        let stdin = Path::new("/dev/stdin");
        if std::fs::metadata(stdin).is_ok_and(|m| m.is_file()) {
            return open(stdin, scratch, progress);
        }
        let scratch = scratch.ok_or_else(|| Error::input(path, "standard input needs a folder for scratch"))?;
        return unpack(path, std::io::stdin().lock(), true, scratch, progress);
    }
    let input = Input::open(path)?;
    let mut magic = [0; MAGIC_BYTES];
    let len = input.len().min(MAGIC_BYTES as u64) as usize;
    input.read_at(&mut magic[..len], 0)?;
    let Some(compression) = Compression::of(&magic[..len]) else { return Ok((input, None)) };
    let Some(scratch) = scratch else {
        let what = format!("is compressed with {compression}, which needs a folder for scratch to unpack it into");
        return Err(Error::input(path, what));
    };
    progress.begin(Stage::Read, input.len());
    let file = File::open(path).map_err(Error::io(path, "cannot open"))?;
    unpack(path, file, false, scratch, progress)
}

/// Unpacks a stream into scratch; one that is not compressed is only copied where `plain` says so.
fn unpack(
    path: &Path,
    stream: impl Read,
    plain: bool,
    scratch: &Scratch,
    progress: &Progress,
) -> Result<(Input, Option<Compression>)> {
    let mut stream = BufReader::with_capacity(PIECE_BYTES, Counted { stream, progress });
    let compression = Compression::of(stream.fill_buf().map_err(Error::io(path, "cannot read"))?);
    let file = scratch.file()?;
    let mut bytes = vec![0; PIECE_BYTES];
    let mut copy = |source: &mut dyn Read| -> Result<()> {
        let mut length = 0;
        loop {
            progress.check()?;
            let n = match source.read(&mut bytes) {
                Ok(0) => return Ok(()),
                Ok(n) => n,
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(e) => return Err(broken(path, compression, &e, length)),
            };
            file.write_all_at(&bytes[..n], length)?;
            length += n as u64;
        }
    };
    match compression {
        Some(Compression::Gzip) => copy(&mut MultiGzDecoder::new(stream))?,
        Some(Compression::Zstd) => {
            let cannot = |e| Error::io(path, "cannot unpack")(e);
            let mut decoder = zstd::Decoder::with_buffer(stream).map_err(cannot)?;
            decoder.window_log_max((scratch.memory() / 2).max(1 << 10).ilog2().min(31)).map_err(cannot)?;
            copy(&mut decoder)?;
        }
        None if plain => copy(&mut stream)?,
        None => return Err(Error::input(path, "changed while it was read")),
    }
    Ok((Input::unpacked(path, file)?, compression))
}

#[cold]
fn broken(path: &Path, compression: Option<Compression>, error: &std::io::Error, length: u64) -> Error {
    let Some(compression) = compression else {
        return Error::io(path, "cannot read")(std::io::Error::from(error.kind()));
    };
    let text: String = error.to_string().escape_debug().take(200).collect();
    let remedy = if text.contains("too much memory") { "; more --memory would do" } else { "" };
    Error::input(
        path,
        format!("its {compression} data cannot be unpacked beyond byte {length} of what it holds: {text}{remedy}"),
    )
}

/// Counts what is read.
struct Counted<'a, R> {
    stream: R,
    progress: &'a Progress,
}

impl<R: Read> Read for Counted<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let n = self.stream.read(buffer)?;
        self.progress.add(n as u64);
        Ok(n)
    }
}
