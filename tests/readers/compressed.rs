//! Files that have to be unpacked.

use super::write::*;
use super::{Scratch, stream, told};
use meshmill::progress::Progress;
use meshmill::read::{Compression, Scan};
use std::io::Write;

/// Bytes as gzip or zstd has them.
pub fn packed(gzip: bool, bytes: &[u8]) -> Vec<u8> {
    if !gzip {
        return zstd::encode_all(bytes, 3).unwrap();
    }
    let mut packer = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packer.write_all(bytes).unwrap();
    packer.finish().unwrap()
}

#[test]
fn every_format_whatever_its_name() {
    let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".to_string();
    let plain = [ply(Encoding::Little, &roof()), binary_stl(b"", &roof_soup()), text.into_bytes()];
    for bytes in &plain {
        let expected = stream(&Scratch::holding("plain", bytes).open_in().unwrap(), 1).unwrap();
        for gzip in [true, false] {
            let whole = packed(gzip, bytes);
            let halves = bytes.split_at(bytes.len() / 2);
            let twice = [packed(gzip, halves.0), packed(gzip, halves.1)].concat();
            for bytes in [whole, twice] {
                let file = Scratch::holding("scan.bin", &bytes);
                let scan = file.open_in().unwrap();
                assert_eq!(scan.compression(), Some(if gzip { Compression::Gzip } else { Compression::Zstd }));
                assert_eq!(stream(&scan, 2).unwrap(), expected);
                assert_eq!(scan.path(), file.path());
                assert_eq!(std::fs::read_dir(file.path().parent().unwrap()).unwrap().count(), 1);
            }
        }
    }
}

#[test]
fn what_cannot_be_unpacked() {
    let bytes = ply(Encoding::Ascii, &roof());
    for gzip in [true, false] {
        let whole = packed(gzip, &bytes);
        for len in 4..whole.len() {
            let file = Scratch::holding("cut", &whole[..len]);
            let text = told(&file.open_in().unwrap_err(), &file.path());
            assert!(text.contains("cannot be unpacked") || text.contains("the file is empty"), "{len}: {text}");
        }
        let file = Scratch::holding("scan", &whole);
        let text = told(&Scan::open(&file.path(), &Progress::default()).unwrap_err(), &file.path());
        assert!(text.ends_with("which needs a folder for scratch to unpack it into"), "{text}");
        let error = file.open_within(100).unwrap_err().to_string();
        assert!(error.ends_with("more than the quota of 1MiB is needed"), "{error}");
    }
    // A small file that holds much: 64 MiB of zeros.
    let bomb = packed(true, &vec![0; 64 << 20]);
    assert!(bomb.len() < 1 << 20);
    let error = Scratch::holding("bomb", &bomb).open_within(1 << 22).unwrap_err().to_string();
    assert!(error.ends_with("more than the quota of 4MiB is needed"), "{error}");
}

#[test]
fn a_window_larger_than_the_memory_is_refused() {
    let mut packer = zstd::Encoder::new(Vec::new(), 1).unwrap();
    packer.window_log(26).unwrap();
    packer.write_all(&vec![7; 1 << 20]).unwrap();
    let file = Scratch::holding("wide", &packer.finish().unwrap());
    let text = told(&file.open_in().unwrap_err(), &file.path());
    assert!(text.contains("too much memory") && text.ends_with("more --memory would do"), "{text}");
}
