//! The buffer between encoders and a file.

use crate::budget::MIB;
use crate::error::{Error, Result};
use crate::progress::Progress;
use std::io::Write;
use std::path::Path;

const BUFFER: usize = MIB as usize;

/// Gathers records into writes of a mebibyte, counts them into the progress and asks it whether to go on.
pub(crate) struct Sink<'a, W> {
    out: W,
    path: &'a Path,
    progress: &'a Progress,
    buffer: Vec<u8>,
    written: u64,
}

impl<'a, W: Write> Sink<'a, W> {
    /// A sink into `out`, which errors call `path`.
    pub(crate) fn new(out: W, path: &'a Path, progress: &'a Progress) -> Self {
        Sink { out, path, progress, buffer: Vec::with_capacity(BUFFER), written: 0 }
    }

    /// Appends bytes.
    pub(crate) fn put(&mut self, bytes: &[u8]) -> Result<()> {
        for piece in bytes.chunks(BUFFER) {
            if self.buffer.len() + piece.len() > BUFFER {
                self.drain()?;
            }
            self.buffer.extend_from_slice(piece);
        }
        Ok(())
    }

    /// Appends one record of `N` bytes an item, encoding straight into the buffer.
    pub(crate) fn put_each<T, const N: usize>(
        &mut self,
        items: &[T],
        record: impl Fn(&T) -> Result<[u8; N]>,
    ) -> Result<()> {
        for batch in items.chunks(BUFFER / N) {
            if self.buffer.len() + batch.len() * N > BUFFER {
                self.drain()?;
            }
            let start = self.buffer.len();
            self.buffer.resize(start + batch.len() * N, 0);
            let (records, _) = self.buffer[start..].as_chunks_mut::<N>();
            for (bytes, item) in records.iter_mut().zip(batch) {
                *bytes = record(item)?;
            }
        }
        Ok(())
    }

    fn drain(&mut self) -> Result<()> {
        self.progress.check()?;
        self.out.write_all(&self.buffer).map_err(Error::io(self.path, "cannot write"))?;
        self.written += self.buffer.len() as u64;
        self.progress.add(self.buffer.len() as u64);
        self.buffer.clear();
        Ok(())
    }

    /// Hands the rest over; the number of bytes in all.
    pub(crate) fn finish(mut self) -> Result<u64> {
        self.drain()?;
        self.out.flush().map_err(Error::io(self.path, "cannot write"))?;
        Ok(self.written)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io;

    /// A disk with room for `left` bytes.
    struct Disk {
        left: usize,
    }

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let taken = bytes.len().min(self.left);
            self.left -= taken;
            if taken == 0 { Err(io::ErrorKind::StorageFull.into()) } else { Ok(taken) }
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_full_disk_is_an_error_wherever_it_strikes() {
        let path = Path::new("night/out.ply");
        let write = |left: usize| {
            let progress = Progress::default();
            let mut sink = Sink::new(Disk { left }, path, &progress);
            let items: Vec<u32> = (0..700_000).collect();
            sink.put(b"head")?;
            sink.put_each(&items, |i| Ok(i.to_le_bytes()))?;
            sink.finish()
        };
        let all = 4 + 2_800_000;
        assert_eq!(write(all).unwrap(), all as u64);
        for left in [0, 3, BUFFER - 1, BUFFER, 2 * BUFFER + 5, all - 1] {
            let error = write(left).unwrap_err();
            assert!(error.to_string().starts_with("night/out.ply: cannot write: "), "{error}");
        }
    }

    #[test]
    fn bytes_keep_their_order_across_the_buffer() {
        let progress = Progress::default();
        let mut out = Vec::new();
        let mut sink = Sink::new(&mut out, Path::new("x"), &progress);
        let words: Vec<u32> = (0..600_000).collect();
        sink.put(&[7; 3]).unwrap();
        sink.put_each(&words, |w| Ok(w.to_le_bytes())).unwrap();
        sink.put(&vec![9; 3 * BUFFER / 2]).unwrap();
        let bytes = sink.finish().unwrap();
        assert_eq!((bytes, progress.now().1), (out.len() as u64, out.len() as u64));
        assert_eq!(out[..3], [7; 3]);
        assert!(out[3..3 + 2_400_000].chunks(4).zip(&words).all(|(b, w)| b == w.to_le_bytes()));
        assert!(out[3 + 2_400_000..].iter().all(|&b| b == 9));
    }

    #[test]
    fn a_signal_ends_it() {
        let signal = std::sync::Arc::new(std::sync::atomic::AtomicUsize::new(2));
        let progress = Progress::cancelled_by(signal);
        let mut sink = Sink::new(Vec::new(), Path::new("x"), &progress);
        assert!(matches!(sink.put(&vec![0; 2 * BUFFER]), Err(Error::Interrupted { signal: 2, .. })));
    }
}
