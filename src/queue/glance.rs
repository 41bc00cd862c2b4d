//! What the first bytes of a scan tell, for plans that are made before any scan is opened.

use std::fs::File;
use std::io::Read;
use std::path::Path;

/// How many faces a scan will turn out to have, about.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Glance {
    /// Faces: as the header says where there is one, else by the size.
    pub faces: u64,
    /// Whether vertices have colours.
    pub coloured: bool,
}

/// Bytes that are looked at.
const LOOK_BYTES: u64 = 4096;

/// Bytes a face of what has no header: text, with half a vertex; and of what is packed.
const TEXT_BYTES: u64 = 60;
const PACKED_BYTES: u64 = 9;
const STL_BYTES: u64 = 50;

impl Glance {
    /// Looks at a file of so many bytes. What cannot be read has no faces.
    pub fn at(path: &Path, bytes: u64) -> Glance {
        let mut head = Vec::new();
        let read = File::open(path).and_then(|file| file.take(LOOK_BYTES).read_to_end(&mut head));
        if bytes == 0 || read.is_err() {
            return Glance::default();
        }
        of(&head, bytes)
    }
}

fn of(head: &[u8], bytes: u64) -> Glance {
    if head.starts_with(b"ply") {
        let text = String::from_utf8_lossy(head);
        let count = text.lines().find_map(|line| line.trim().strip_prefix("element face ")?.trim().parse().ok());
        // A header that lies does not make a plan wait for ever: a face takes four bytes at least.
        let faces = count.map_or(bytes / TEXT_BYTES, |count: u64| count.min(bytes / 4));
        let colour = |line: &str| line.trim().starts_with("property ") && line.trim().ends_with(" red");
        let header = text.split("end_header").next().unwrap_or_default();
        return Glance { faces, coloured: header.lines().any(colour) };
    }
    let packed = head.starts_with(&[0x1f, 0x8b]) || head.starts_with(&[0x28, 0xb5, 0x2f, 0xfd]);
    let stl = head.get(80..84).and_then(|n| n.try_into().ok()).map(|n| u64::from(u32::from_le_bytes(n)));
    let faces = match stl {
        _ if packed => bytes / PACKED_BYTES,
        Some(n) if n > 0 && n <= bytes / STL_BYTES && !head.starts_with(b"solid") => n,
        _ if head.iter().all(|byte| byte.is_ascii()) => bytes / TEXT_BYTES,
        _ => bytes / STL_BYTES,
    };
    Glance { faces, coloured: false }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_are_believed_within_reason() {
        let ply =
            |faces: &str| format!("ply\nelement vertex 3\nproperty uchar red\nelement face {faces}\nend_header\n");
        assert_eq!(of(ply("12").as_bytes(), 1000), Glance { faces: 12, coloured: true });
        assert_eq!(of(ply("99999").as_bytes(), 1000).faces, 250);
        let mut stl = vec![0; 84];
        stl[80] = 7;
        assert_eq!(of(&stl, 84 + 350).faces, 7);
        stl[83] = 200;
        assert_eq!(of(&stl, 5000).faces, 100);
        assert_eq!(of(b"v 0 0 0\nv 1 0 0\n", 600), Glance { faces: 10, coloured: false });
        assert_eq!(of(b"\x1f\x8b\x08", 90).faces, 10);
        assert_eq!(Glance::at(Path::new("nowhere"), 5), Glance::default());
    }
}
