//! PLY: what is accepted, and what is refused in which words.

use super::write::*;
use super::{Content, Random, Scratch, complaint, read, stream};
use meshmill::progress::Progress;
use meshmill::read::{Crew, Format, Layout, Scalar, Scan, load};
use std::io::{Seek, SeekFrom, Write};

fn content(bytes: &[u8]) -> (Scan, Content) {
    read(&Scratch::holding("scan.ply", bytes).path()).unwrap()
}

fn triangles_of(sides: &[&[u32]]) -> Vec<[u32; 3]> {
    sides.iter().flat_map(|p| fan(p)).collect()
}

#[test]
fn the_plain_file_in_every_encoding() {
    for (encoding, format) in
        ENCODINGS.into_iter().zip([Format::PlyAscii, Format::PlyLittleEndian, Format::PlyBigEndian])
    {
        let bytes = ply(encoding, &roof());
        let (scan, found) = content(&bytes);
        assert_eq!((scan.format(), scan.layout(), scan.scalar()), (format, Layout::Indexed, Scalar::F32));
        assert_eq!((scan.vertex_count(), scan.face_count(), scan.triangle_count()), (5, 4, 4));
        assert_eq!((scan.bytes(), scan.trailing_bytes()), (bytes.len() as u64, 0));
        assert_eq!(found.positions, ROOF);
        assert_eq!(found.triangles, triangles_of(&SIDES));
    }
}

#[test]
fn every_type_and_order_of_properties() {
    let scalars = [
        ["char", "int8"],
        ["uchar", "uint8"],
        ["short", "int16"],
        ["ushort", "uint16"],
        ["int", "int32"],
        ["uint", "uint32"],
        ["float", "float32"],
        ["double", "float64"],
    ];
    let orders = [["x", "y", "z"], ["z", "y", "x"], ["y", "z", "x"]];
    let mut random = Random(1);
    for encoding in ENCODINGS {
        for coordinate in scalars.as_flattened() {
            for order in orders {
                let index = *random.pick(&scalars.as_flattened()[..12]);
                let count = *random.pick(&scalars.as_flattened()[..12]);
                let [mut vertex, mut face] = roof();
                vertex.properties = order.map(|name| (name, Type::One(coordinate))).to_vec();
                vertex.properties.insert(1, ("quality", Type::One("double")));
                vertex.properties.push(("red", Type::One("uchar")));
                for record in &mut vertex.records {
                    record.insert(1, Value::One(-0.125));
                    record.push(Value::One(200.0));
                }
                face.properties = vec![
                    ("flags", Type::One("short")),
                    ("vertex_index", Type::List(count, index)),
                    ("area", Type::One("float")),
                ];
                for record in &mut face.records {
                    record.insert(0, Value::One(-3.0));
                    record.push(Value::One(3.0));
                }
                let (scan, found) = content(&ply(encoding, &[vertex, face]));
                let place = |axis: usize| order.iter().position(|n| *n == ["x", "y", "z"][axis]).unwrap();
                let whole = !coordinate.starts_with("float") && *coordinate != "double";
                let stored = |x: f64| if whole { x.trunc() } else { x };
                let expected = ROOF.map(|p| [0, 1, 2].map(|axis| stored(p[place(axis)])));
                assert_eq!(found.positions, expected, "{encoding:?} {coordinate} {order:?}");
                assert_eq!(found.triangles, triangles_of(&SIDES), "{encoding:?} {count} {index}");
                let wide = ["int", "int32", "uint", "uint32", "double", "float64"].contains(coordinate);
                assert_eq!(scan.scalar() == Scalar::F64, wide);
            }
        }
    }
}

fn other(name: &'static str, lists: bool) -> Element {
    let list = |n: usize| Value::List(vec![3.0; n]);
    let (kind, values) = if lists {
        (Type::List("uchar", "int"), vec![vec![list(2)], vec![list(0)], vec![list(5)]])
    } else {
        (Type::One("short"), vec![vec![Value::One(3.0)]; 3])
    };
    Element { name, properties: vec![("vertex_indices", kind)], records: values }
}

#[test]
fn other_elements_before_between_and_after() {
    for encoding in ENCODINGS {
        for lists in [false, true] {
            let [vertex, face] = roof();
            let empty = Element { name: "nothing", properties: vec![], records: vec![vec![]; 7] };
            let none = Element { records: vec![], ..other("none", true) };
            let mut elements = vec![other("a", lists), vertex, empty, other("b", lists), face, none, other("c", lists)];
            let expected = triangles_of(&SIDES);
            for _ in 0..2 {
                let (scan, found) = content(&ply(encoding, &elements));
                assert_eq!((&found.positions[..], &found.triangles[..]), (&ROOF[..], &expected[..]));
                assert_eq!(scan.trailing_bytes(), 0);
                // Faces before vertices.
                elements.reverse();
            }
        }
    }
}

#[test]
fn polygons_of_every_size_and_lists_everywhere() {
    let hundred: Vec<u32> = (0..100).map(|i| i % 5).collect();
    let polygons: [&[u32]; 8] = [&[], &[0, 1, 2, 3], &[2], &[0, 1, 4], &hundred, &[1, 2], &[4, 3, 2, 1, 0], &[]];
    for encoding in ENCODINGS {
        for lists in [false, true] {
            let (mut vertex, mut face) = (vertices(&ROOF), faces(&polygons));
            if lists {
                vertex.properties.insert(1, ("normals", Type::List("ushort", "double")));
                face.properties.insert(0, ("texcoord", Type::List("uchar", "float")));
                face.properties.push(("more", Type::List("int", "char")));
                vertex.records.iter_mut().enumerate().for_each(|(i, r)| r.insert(1, Value::List(vec![0.5; i])));
                for (i, record) in face.records.iter_mut().enumerate() {
                    record.insert(0, Value::List(vec![0.25; i % 3]));
                    record.push(Value::List(vec![7.0; 10 * i]));
                }
            }
            let (scan, found) = content(&ply(encoding, &[vertex, face]));
            assert_eq!(found.positions, ROOF);
            assert_eq!(found.triangles, triangles_of(&polygons));
            assert_eq!((scan.face_count(), scan.triangle_count()), (8, 2 + 1 + 98 + 3));
        }
    }
}

#[test]
fn a_section_of_just_the_size_of_triangles_need_not_be_triangles() {
    // A polygon of two corners and one of four are as long as two triangles.
    let polygons: [&[u32]; 4] = [&[0, 1, 4], &[1, 2], &[0, 1, 2, 3], &[2, 3, 4]];
    for encoding in ENCODINGS {
        let (scan, found) = content(&ply(encoding, &[vertices(&ROOF), faces(&polygons)]));
        assert_eq!((scan.face_count(), scan.triangle_count()), (4, 4));
        assert_eq!(found.triangles, triangles_of(&polygons));
    }
}

#[test]
fn header_lines_as_they_come() {
    let [vertex, face] = roof();
    let elements = [vertex, face];
    for encoding in ENCODINGS {
        for ending in ["\n", "\r\n", "\r"] {
            let header = String::from_utf8(header(encoding, &elements, ending)).unwrap();
            let untidy = header
                .replace("element", &format!("{ending}comment ply{ending}obj_info element{ending}  elem_nt"))
                .replace("elem_nt", "element")
                .replace("float", "\tfloat  ")
                .replace("end_header", &format!("comment{ending}property float scan.angle (deg){ending}end_header "))
                .replace("property float scan.angle (deg)", "comment caf\u{e9}");
            let latin1: Vec<u8> = untidy.chars().map(|c| c as u8).collect();
            let (scan, found) = content(&[latin1, payload(encoding, &elements, " ", ending)].concat());
            assert_eq!(found.positions, ROOF, "{encoding:?} {ending:?}");
            assert_eq!(found.triangles, triangles_of(&SIDES), "{encoding:?} {ending:?}");
            assert_eq!(scan.trailing_bytes(), 0);
        }
    }
}

#[test]
fn a_binary_payload_may_begin_with_a_line_ending() {
    for (ending, first) in [("\n", 10.0), ("\n", 13.0), ("\r\n", 10.0), ("\r\n", 13.0), ("\r", 10.0), ("\r", 13.0)] {
        let [mut vertex, face] = roof();
        vertex.properties.insert(0, ("label", Type::One("uchar")));
        vertex.records.iter_mut().for_each(|r| r.insert(0, Value::One(first)));
        let elements = [vertex, face];
        let header = header(Encoding::Little, &elements, ending);
        let (_, found) = content(&[header, payload(Encoding::Little, &elements, "", "")].concat());
        assert_eq!(found.positions, ROOF, "{ending:?} {first}");
    }
}

#[test]
fn odd_and_repeated_names_that_nobody_asks_for() {
    let [mut vertex, face] = roof();
    for name in ["scalar_Intensity_(1)", "scalar_Intensity_(1)", "9lives", "x:y", "schr\u{e4}g"] {
        vertex.properties.insert(2, (name, Type::One("uchar")));
        vertex.records.iter_mut().for_each(|r| r.insert(2, Value::One(1.0)));
    }
    let edge = Element { name: "edge", ..other("", false) };
    for encoding in ENCODINGS {
        let (_, found) = content(&ply(encoding, &[edge.clone(), vertex.clone(), edge.clone(), face.clone()]));
        assert_eq!(found.positions, ROOF);
    }
}

#[test]
fn text_needs_no_lines() {
    let elements = roof();
    for (space, ending) in [(" ", " "), ("\n", ""), ("\t \r\n\n", "\r"), ("\x0b", "\x0c"), (" ", "\n\n\n")] {
        let bytes = [header(Encoding::Ascii, &elements, "\n"), payload(Encoding::Ascii, &elements, space, ending)];
        let (scan, found) = content(&bytes.concat());
        assert_eq!((found.positions, scan.trailing_bytes()), (ROOF.to_vec(), 0));
    }
    let text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty double y\nproperty float z\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n\
        +1 1e-3 -.5  1.25E2 0.1 2.  1e-40 0.1 -0\n3 0 +1 2.0";
    let (_, found) = content(text.as_bytes());
    let expected = [[1.0, 1e-3, -0.5], [125.0, 0.1, 2.0], [f64::from(1e-40f32), 0.1, 0.0]];
    assert_eq!((&found.positions[..], &found.triangles[..]), (&expected[..], &[[0, 1, 2]][..]));
}

#[test]
fn words_that_lie_across_windows() {
    let mut random = Random(5);
    let positions: Vec<[f64; 3]> = (0..90_000)
        .map(|_| [0; 3].map(|_| f64::from(f32::from_bits(random.draw() as u32 & 0x7f7f_ffff | 1))))
        .collect();
    let polygons: Vec<Vec<u32>> =
        (0..60_000).map(|_| (0..random.below(7)).map(|_| random.below(90_000) as u32).collect()).collect();
    let polygons: Vec<&[u32]> = polygons.iter().map(|p| &p[..]).collect();
    for encoding in ENCODINGS {
        let file = Scratch::holding("scan.ply", &ply(encoding, &[vertices(&positions), faces(&polygons)]));
        let scan = Scan::open(&file.path(), &Progress::default()).unwrap();
        let one = stream(&scan, 1).unwrap();
        assert_eq!(one.triangles, triangles_of(&polygons));
        assert!(one.positions == positions);
        assert!([2, 5].iter().all(|workers| stream(&scan, *workers).unwrap() == one));
    }
}

#[test]
fn non_finite_coordinates_pass_through() {
    let mut positions = ROOF;
    positions[1] = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY];
    for encoding in ENCODINGS {
        let (scan, found) = content(&ply(encoding, &[vertices(&positions), faces(&SIDES)]));
        assert!(found.positions[1][0].is_nan() && found.positions[1][1..] == positions[1][1..]);
        let what = scan.vertex_error(1, "is not finite".into()).to_string();
        assert!(
            what.ends_with(if encoding == Encoding::Ascii { "vertex 1: is not finite" } else { ") is not finite" })
                || what.contains("vertex 1 (byte "),
            "{what}"
        );
    }
}

#[test]
fn trailing_bytes_are_counted() {
    for encoding in ENCODINGS {
        let mut bytes = ply(encoding, &roof());
        bytes.extend(b"  more\n");
        let (scan, found) = content(&bytes);
        assert_eq!(scan.trailing_bytes(), if encoding == Encoding::Ascii { 5 } else { 7 });
        assert_eq!(found.triangles.len(), 4);
    }
}

#[test]
fn a_file_cut_at_any_byte_is_refused() {
    let mut variants = vec![roof().to_vec()];
    variants.push(vec![vertices(&ROOF), faces(&[&[0, 1, 2, 3], &[], &[0, 1, 4]])]);
    variants.push(vec![faces(&SIDES), vertices(&ROOF), other("c", true)]);
    for encoding in ENCODINGS {
        for elements in &variants {
            let bytes = ply(encoding, elements);
            // Of a text the last number may lose digits and still be one.
            let shortest = if encoding == Encoding::Ascii { bytes.trim_ascii_end().len() } else { bytes.len() };
            for len in 0..shortest {
                let what = complaint("cut.ply", &bytes[..len]);
                assert!(
                    ["ends", "end_header", "is not a mesh", "empty"].iter().any(|word| what.contains(word)),
                    "{len} of {}: {what}",
                    bytes.len()
                );
            }
        }
    }
}

#[test]
fn counts_that_lie() {
    for encoding in ENCODINGS {
        let text = header(encoding, &roof(), "\n");
        let text = String::from_utf8(text).unwrap();
        let body = [payload(encoding, &roof(), " ", "\n"), vec![b' '; 6000]].concat();
        for count in ["2147483648", "1099511627776", "18446744073709551615"] {
            for (from, kind) in [("vertex 5", "vertex"), ("face 4", "face")] {
                let lying = text.replace(from, &format!("{kind} {count}"));
                let what = complaint("lying.ply", &[lying.as_bytes(), &body].concat());
                assert!(what.starts_with(kind), "{what}");
                assert!(what.contains(&format!("promises {count} of its kind")), "{what}");
            }
        }
        for count in ["18446744073709551616", "99999999999999999999999999", "-1", "5.0", "five", "+5"] {
            let lying = text.replace("vertex 5", &format!("vertex {count}"));
            let what = complaint("lying.ply", &[lying.as_bytes(), &body].concat());
            assert!(what.starts_with("header line 2 (byte "), "{what}");
            assert!(what.ends_with(&format!("count `{count}`, expected a number from 0 to 2^64 - 1")), "{what}");
        }
    }
}

#[test]
fn lists_that_lie() {
    let mut bytes = ply(Encoding::Little, &roof());
    let faces = bytes.len() - 4 * 13;
    bytes[faces + 13] = 200;
    assert_eq!(
        complaint("lying.ply", &bytes),
        format!("face 1 (byte {}): the file ends within it, but the header promises 4 of its kind", faces + 13)
    );
    let mut wide = roof();
    wide[1].properties[0].1 = Type::List("int", "int");
    for (count, what) in
        [(-3.0, "a list of -3 values"), (65_537.0, "a polygon of 65537 corners; at most 65536 are read")]
    {
        for encoding in ENCODINGS {
            let mut bytes = ply(encoding, &wide);
            let begin = bytes.len() - payload(encoding, &wide[1..], " ", "\n").len();
            let mut field = Vec::new();
            number(&mut field, encoding, "int", count);
            let old = if encoding == Encoding::Ascii { 1 } else { 4 };
            bytes.splice(begin..begin + old, field);
            let told = complaint("lying.ply", &bytes);
            assert!(told.starts_with("face 0 (byte ") && told.ends_with(what), "{told}");
        }
    }
}

#[test]
fn a_polygon_of_the_most_corners() {
    let polygon: Vec<u32> = (0..65_536).map(|i| i % 5).collect();
    for encoding in ENCODINGS {
        let [vertex, mut face] = roof();
        face.properties[0].1 = Type::List("uint", "ushort");
        face.records.push(vec![Value::List(polygon.iter().map(|v| f64::from(*v)).collect())]);
        let (scan, found) = content(&ply(encoding, &[vertex, face]));
        assert_eq!(scan.triangle_count(), 4 + 65_534);
        assert_eq!(found.triangles[4..], fan(&polygon));
    }
}

#[test]
fn indices_that_no_vertex_has() {
    for encoding in ENCODINGS {
        for (kind, index) in [("int", -1.0), ("int", 5.0), ("uint", 4e9), ("uchar", 255.0), ("short", -32768.0)] {
            for (polygons, at) in [(&SIDES[..], 2), (&[&[0, 1, 2, 3], SIDES[0]][..], 1)] {
                let [vertex, _] = roof();
                let mut face = faces(polygons);
                face.properties[0].1 = Type::List("uchar", kind);
                let Value::List(corners) = &mut face.records[at][0] else { unreachable!() };
                corners[1] = index;
                let what = complaint("scan.ply", &ply(encoding, &[vertex, face]));
                assert!(what.starts_with(&format!("face {at} (byte ")), "{what}");
                assert!(what.ends_with(&format!("): index {index}, but the file has 5 vertices")), "{what}");
            }
        }
    }
}

#[test]
fn the_byte_told_is_the_byte_that_is_wrong() {
    let mut bytes = ply(Encoding::Little, &roof());
    let at = bytes.len() - 13 - 4;
    bytes[at] = 77;
    let what = complaint("scan.ply", &bytes);
    assert_eq!(what, format!("face 2 (byte {at}): index 77, but the file has 5 vertices"));
    let text = String::from_utf8(ply(Encoding::Ascii, &roof())).unwrap();
    let at = text.find("0.75").unwrap();
    let what = complaint("scan.ply", text.replace("0.75", "0.7q").as_bytes());
    assert_eq!(what, format!("vertex 4 (byte {at}): `0.7q`, expected a number"));
    let long = text.replace("0.75", &"7".repeat(2000));
    assert!(complaint("scan.ply", long.as_bytes()).contains("is no number and no keyword"));
}

#[test]
fn headers_that_make_no_sense() {
    let plain = String::from_utf8(header(Encoding::Little, &roof(), "\n")).unwrap();
    let body = payload(Encoding::Little, &roof(), "", "");
    for (from, to, what) in [
        ("vertex 5", "vertex 0", "has no vertex"),
        ("face 4", "face 0", "has no faces"),
        ("element vertex", "element point", "has no vertex"),
        ("element face", "element edge", "has no faces"),
        ("element face", "element vertex", "a second element vertex"),
        ("float y", "float x", "a second property x"),
        ("float y", "float w", "vertices have no property `y`"),
        ("property float y", "property list uchar float y", "vertex property `y` is a list"),
        ("list uchar int", "list uchar float", "vertex indices are fractional"),
        ("list uchar int", "list float int", "a list has a fractional number"),
        ("list uchar int", "int", "is not a list"),
        ("vertex_indices", "corners", "no list property `vertex_indices`"),
        ("float y", "real y", "`real` is not a type"),
        ("element face", "elephant face", "`elephant face 4` is not a line of a PLY header"),
        ("format binary_little_endian 1.0\n", "", "No format line"),
        ("binary_little_endian", "binary_middle_endian", "is not a format that PLY has"),
        ("endian 1.0", "endian 2.0", "is not a format that PLY has"),
        ("element vertex 5\n", "", "without preceding element"),
        ("end_header", "end_head", "end_head"),
    ] {
        let header = plain.replacen(from, to, 1);
        let told = complaint("scan.ply", &[header.as_bytes(), &body].concat());
        assert!(told.contains(what), "{from} -> {to}: {told}");
    }
    let endless = [b"ply\nformat ascii 1.0\n".to_vec(), b"comment more\n".repeat(100_000)].concat();
    assert!(complaint("scan.ply", &endless).contains("no end_header line within a mebibyte"));
    let empties = ply(Encoding::Little, &[vertices(&ROOF), faces(&[&[], &[0], &[1, 2]])]);
    assert!(complaint("scan.ply", &empties).contains("every polygon has fewer than three corners"));
}

#[test]
fn more_empty_polygons_than_fit_32_bits() {
    // One empty polygon a byte: the file is a hole but for three triangles, at both ends and in the middle.
    const EMPTY: u64 = (1 << 32) + 10;
    let file = Scratch::new("sparse.ply");
    let [vertex, _] = roof();
    let text = String::from_utf8(header(Encoding::Little, &roof(), "\n")).unwrap();
    let text = text.replace("face 4", &format!("face {}", EMPTY + 3));
    let mut out = std::fs::File::create(file.path()).unwrap();
    out.write_all(text.as_bytes()).unwrap();
    out.write_all(&payload(Encoding::Little, &[vertex], "", "")).unwrap();
    for (side, skip) in SIDES.iter().zip([0, EMPTY / 2, EMPTY - EMPTY / 2]) {
        out.seek(SeekFrom::Current(skip as i64)).unwrap();
        out.write_all(&payload(Encoding::Little, &[faces(&[side])], "", "")).unwrap();
    }
    drop(out);
    let (scan, found) = read(&file.path()).unwrap();
    assert_eq!((scan.face_count(), scan.triangle_count(), scan.trailing_bytes()), (EMPTY + 3, 3, 0));
    assert_eq!(found.triangles, triangles_of(&SIDES[..3]));
}

#[test]
fn more_vertices_than_fit_32_bits() {
    const VERTICES: u64 = (1 << 32) + 10;
    let file = Scratch::new("sparse.ply");
    let [mut vertex, mut face] = roof();
    vertex.properties = ["x", "y", "z"].map(|name| (name, Type::One("uchar"))).to_vec();
    vertex.records.clear();
    face.properties[0].1 = Type::List("uchar", "uint");
    let far = u32::MAX;
    face.records = vec![vec![Value::List(vec![0.0, 1.0, far.into()])]];
    let text = String::from_utf8(header(Encoding::Little, &[vertex, face.clone()], "\n")).unwrap();
    let text = text.replace("vertex 0", &format!("vertex {VERTICES}"));
    let mut out = std::fs::File::create(file.path()).unwrap();
    out.write_all(text.as_bytes()).unwrap();
    out.seek(SeekFrom::Current(u64::from(far) as i64 * 3)).unwrap();
    out.write_all(&[7, 8, 9]).unwrap();
    out.seek(SeekFrom::Start(text.len() as u64 + VERTICES * 3)).unwrap();
    out.write_all(&payload(Encoding::Little, &[face], "", "")).unwrap();
    drop(out);
    let progress = Progress::default();
    let scan = Scan::open(&file.path(), &progress).unwrap();
    assert_eq!((scan.vertex_count(), scan.triangle_count()), (VERTICES, 1));
    let crew = Crew { workers: 2, progress: &progress };
    let sample = scan.sample(&crew, 10).unwrap();
    assert_eq!(sample.triangles, [[[0.0; 3], [0.0; 3], [7.0, 8.0, 9.0]]]);
    assert_eq!(sample.blocks_per_triangle, 2.0);
    assert!(load::<f32>(&scan, &crew, u64::MAX).unwrap_err().to_string().contains("more than 4294967294 vertices"));
    let last = scan.vertex_error(far.into(), "here".into()).byte();
    assert_eq!(last, Some(text.len() as u64 + u64::from(far) * 3));
}
