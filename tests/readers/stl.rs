//! STL: what is accepted, and what is refused in which words.

use super::write::*;
use super::{Content, Scratch, complaint, read, stream};
use meshmill::progress::Progress;
use meshmill::read::{Format, Layout, Scalar, Scan};

fn content(bytes: &[u8]) -> (Scan, Content) {
    read(&Scratch::holding("scan.stl", bytes).path()).unwrap()
}

#[test]
fn binary_whatever_the_header_says() {
    for head in [&b""[..], b"solid", b"solid teapot\nfacet normal", b"ply"] {
        let mut bytes = binary_stl(head, &roof_soup());
        if head == b"ply" {
            bytes[3] = b'x';
        }
        let (scan, found) = content(&bytes);
        assert_eq!((scan.format(), scan.layout(), scan.scalar()), (Format::StlBinary, Layout::Soup, Scalar::F32));
        assert_eq!((scan.face_count(), scan.triangle_count(), scan.vertex_count()), (4, 4, 12));
        assert_eq!((found.soup, scan.trailing_bytes()), (roof_soup(), 0));
        assert_eq!(scan.vertex_error(7, String::new()).byte(), Some(84 + 2 * 50 + 12 + 12));
    }
}

#[test]
fn binary_with_trailing_bytes() {
    for head in [&b""[..], b"solid"] {
        let mut bytes = binary_stl(head, &roof_soup());
        bytes.extend([1; 33]);
        let (scan, found) = content(&bytes);
        assert_eq!((found.soup, scan.trailing_bytes()), (roof_soup(), 33));
    }
}

#[test]
fn binary_that_is_broken() {
    let bytes = binary_stl(b"", &roof_soup());
    for len in 84..bytes.len() {
        let whole = (len - 84) / 50;
        assert_eq!(
            complaint("cut.stl", &bytes[..len]),
            format!(
                "face {whole} (byte {}): the file ends at byte {len}, but its 4 faces need 284 bytes",
                84 + whole * 50
            )
        );
    }
    assert_eq!(complaint("cut.stl", &bytes[..83]), "is not a mesh as PLY, STL, OBJ, OFF or glTF have it");
    assert_eq!(complaint("none.stl", &binary_stl(b"", &[])), "has no faces: the header counts 0");
    let mut soup = roof_soup();
    soup[2][1][2] = f64::NAN;
    assert_eq!(
        complaint("nan.stl", &binary_stl(b"", &soup)),
        format!("face 2 (byte {}): coordinate NaN, expected a finite number", 84 + 2 * 50 + 12 + 5 * 4)
    );
    let mut lying = bytes.clone();
    lying[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(complaint("lying.stl", &lying).ends_with("but its 4294967295 faces need 214748364834 bytes"));
}

#[test]
fn text_as_it_comes() {
    let plain = ascii_stl("a roof", &roof_soup());
    let shouted = plain.to_uppercase();
    let lines = plain.replace('\n', "\r\n");
    let old = plain.replace('\n', "\r");
    let spaced = plain.replace(' ', " \t ").replace("solid \t a \t roof", "solid a roof");
    let nameless = plain.replace(" a roof", "");
    let indented = format!("\n  {plain}");
    let unended = plain.trim_end().to_string();
    for text in [&plain, &shouted, &lines, &old, &spaced, &nameless, &indented, &unended] {
        let (scan, found) = content(text.as_bytes());
        assert_eq!((scan.format(), scan.trailing_bytes()), (Format::StlAscii, 0), "{text}");
        assert_eq!(found.soup, roof_soup(), "{text}");
    }
    let two = format!("{plain}\n\n{}{}", ascii_stl("", &[]), ascii_stl("endsolid facet", &roof_soup()[..1]));
    let (scan, found) = content(two.as_bytes());
    assert_eq!((scan.face_count(), found.soup.len()), (5, 5));
    let (scan, _) = content(format!("{plain}\nthe end").as_bytes());
    assert_eq!(scan.trailing_bytes(), 7);
}

#[test]
fn long_text_by_any_crew() {
    let soup: Vec<[[f64; 3]; 3]> =
        (0..40_000).map(|i| [0, 1, 2].map(|c| [f64::from(i), f64::from(c), f64::from(i % 7)])).collect();
    let file = Scratch::holding("long.stl", ascii_stl("long", &soup).as_bytes());
    let scan = Scan::open(&file.path(), &Progress::default()).unwrap();
    assert!([1, 2, 4].iter().all(|workers| stream(&scan, *workers).unwrap().soup == soup));
}

#[test]
fn text_that_is_broken() {
    let plain = ascii_stl("a roof", &roof_soup());
    for len in 6..plain.trim_end().len() - " a roof".len() {
        let what = complaint("cut.stl", &plain.as_bytes()[..len]);
        assert!(what.contains("ends here, expected `endsolid`") || what.contains(", expected `"), "{len}: {what}");
    }
    for (from, to, what) in [
        ("0.5 7.5e-1", "0.5 7.5e-q", "`7.5e-q`, expected a finite number"),
        ("0.5 7.5e-1", "0.5 nan", "`nan`, expected a finite number"),
        ("0.5 7.5e-1", "0.5 1e39", "`1e39`, expected a finite number"),
        ("outer loop", "inner loop", "`inner`, expected `outer`"),
        (" endloop", "vertex 0 0 0\nendloop", "`vertex`, expected `endloop`"),
        ("facet normal", "facets normal", "`facets`, expected `facet` or `endsolid`"),
    ] {
        let what_is_told = complaint("scan.stl", plain.replacen(from, to, 1).as_bytes());
        assert!(what_is_told.starts_with("face 0 (byte ") && what_is_told.ends_with(what), "{what_is_told}");
    }
    assert_eq!(complaint("scan.stl", b"solid none\nendsolid none\n"), "has no faces: no facet in any solid");
}

#[test]
fn what_is_foreign() {
    let png = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\x02\0\0\0\x02\0\x08\x06\0\0\0".repeat(40);
    for bytes in [&b"x"[..], b"plywood", &b"# a comment\nvoid f(0) {\n".repeat(99), &png, &[0; 1000]] {
        assert_eq!(complaint("foreign.bin", bytes), "is not a mesh as PLY, STL, OBJ, OFF or glTF have it");
    }
}
