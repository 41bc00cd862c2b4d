//! OBJ and OFF: what is accepted, and what is refused in which words.

use super::write::*;
use super::{Content, Random, Scratch, complaint, read, stream};
use meshmill::progress::Progress;
use meshmill::read::{Carrier, Format, Layout, Scalar, Scan};

fn content(name: &'static str, text: &str) -> (Scan, Content) {
    read(&Scratch::holding(name, text.as_bytes()).path()).unwrap()
}

/// A roof in OBJ, its corners written by `corner` from the number of a vertex.
fn obj(corner: impl Fn(u32) -> String) -> String {
    let mut text = String::from("# a roof\nmtllib roof.mtl\no roof\n");
    ROOF.iter().for_each(|[x, y, z]| text += &format!("v {x} {y} {z:e}\n"));
    text += "vt 0.5 0.5\nvn 0 0 1\nusemtl tiles\ng sides north\ns off\n";
    SIDES.iter().for_each(|s| text += &format!("f {} {} {}\n", corner(s[0]), corner(s[1]), corner(s[2])));
    text
}

#[test]
fn obj_as_it_comes() {
    let plain = obj(|v| (v + 1).to_string());
    let variants = [
        plain.clone(),
        obj(|v| format!("{}/1", v + 1)),
        obj(|v| format!("{}//1", v + 1)),
        obj(|v| format!("{}/1/1", v + 1)),
        obj(|v| format!("{}", i64::from(v) - 5)),
        obj(|v| format!("{}/-1/-1", i64::from(v) - 5)),
        plain.replace('\n', "\r\n"),
        plain.replace('\n', "\r"),
        plain.replace("v 0.5", "v \\\n0.5").replace("f 1 2", "f 1\\\r\n2"),
        plain.replace(' ', " \t ").replace('\n', "  \n\n"),
        plain.replace("f 1 2 5\n", "f 1 2 5 # north\nl 1 2\np 3\n"),
        format!("\u{feff}{plain}"),
        plain.trim_end().to_string(),
        format!("f 1 2 5\n{}", plain.replace("f 1 2 5\n", "")),
        plain.replace("v 1 0 0e0", "v 1 0 0e0 1 0.5 0.25").replace("v 1 1 0e0", "v 1 1 0e0 1.0"),
    ];
    for text in &variants {
        let (scan, found) = content("scan", text);
        assert_eq!(
            (scan.format(), scan.layout(), scan.scalar()),
            (Format::Obj, Layout::Indexed, Scalar::F32),
            "{text}"
        );
        assert_eq!((scan.vertex_count(), scan.face_count(), scan.triangle_count()), (5, 4, 4), "{text}");
        assert_eq!((&found.positions[..], found.triangles), (&ROOF[..], triangles()), "{text}");
        let corners = scan.attributes().into_iter().filter(|a| a.carrier == Carrier::Corner);
        assert_eq!(corners.count(), 2);
        let byte = scan.vertex_error(4, String::new()).byte().unwrap() as usize;
        assert!(text[byte..].trim_start_matches(['\\', '\n', ' ', '\t']).starts_with("0.5"), "{text}");
    }
    let coloured = plain.replace("v 0 0 0e0\n", "v 0 0 0e0 1 0.5 0.25\n");
    let (scan, _) = content("scan.obj", &coloured);
    assert_eq!((scan.attributes()[0].name.as_str(), scan.attributes()[0].carrier), ("colour", Carrier::Vertex));
}

fn triangles() -> Vec<[u32; 3]> {
    SIDES.iter().flat_map(|s| fan(s)).collect()
}

#[test]
fn polygons_become_fans_and_short_ones_are_counted() {
    let text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 2 0\nf 1 2 3 4 5\nf 1 2\nf\nf -1 -2 -3 -4\nfo 3 2 1\n";
    let (scan, found) = content("scan.obj", text);
    assert_eq!((scan.face_count(), scan.triangle_count(), scan.short_polygons()), (4, 6, 1));
    assert_eq!(found.triangles, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [4, 3, 2], [4, 2, 1], [2, 1, 0]]);
}

#[test]
fn obj_that_is_broken() {
    let plain = obj(|v| (v + 1).to_string());
    for (from, to, what) in [
        ("f 2 3 5", "f 2 3 6", "index 6, but the file has 5 vertices"),
        ("f 2 3 5", "f 2 0 5", "index 0, but the file has 5 vertices"),
        ("f 2 3 5", "f 2 -6 5", "index -6, but the file has 5 vertices"),
        ("f 2 3 5", "f 2 99999999999999999999 5", "expected a vertex number, as in 7, 7/8 or 7//9"),
        ("f 2 3 5", "f 2 x 5", "`x`, expected a vertex number, as in 7, 7/8 or 7//9"),
    ] {
        let told = complaint("scan.obj", plain.replacen(from, to, 1).as_bytes());
        let word = to.split(' ').nth(if to.ends_with('6') { 3 } else { 2 }).unwrap();
        let byte = plain.find(from).unwrap() + to.find(word).unwrap();
        assert!(told.starts_with(&format!("face 1 (byte {byte}): ")) && told.ends_with(what), "{told}");
    }
    let told = complaint("scan.obj", plain.replace("v 1 1 0e0", "v 1 up 0").as_bytes());
    assert!(told.starts_with("vertex 2 (byte ") && told.ends_with("`up`, expected a number"), "{told}");
    let told = complaint("scan.obj", plain.replace("v 1 1 0e0", "v 1 1").as_bytes());
    assert!(told.starts_with("vertex 2 (byte ") && told.ends_with("fewer than three coordinates"), "{told}");
    assert_eq!(complaint("scan.obj", b"v 0 0 0\nv 1 0 0\n"), "has no faces: no line begins with `f`");
    assert_eq!(complaint("scan.obj", b"g none\nvn 0 0 1\n"), "has no vertex: no line begins with `v`");
    assert!(complaint("scan.obj", b"v 0 0 0\nv 1 0 0\nf 1 2\n").contains("fewer than three corners"));
    // Negative numbers reach back from where they are, not from the end.
    let told = complaint("scan.obj", b"v 0 0 0\nv 1 0 0\nf -1 -2 -3\nv 1 1 0\n");
    assert!(told.ends_with("index -3, but the file has 3 vertices"), "{told}");
    let long = format!("v 0 0 0\n# {}\n", "x".repeat(3 << 20));
    assert!(complaint("scan.obj", long.as_bytes()).ends_with("is longer than a mebibyte"));
    let round = format!("v 0 0 0\nf{}\n", " 1".repeat(70_000));
    assert!(complaint("scan.obj", round.as_bytes()).contains("a polygon of 70000 corners; at most 65536 are read"));
}

/// Vertices and faces mixed, several mebibytes, negative and positive numbers.
#[test]
fn long_text_by_any_crew() {
    let mut random = Random(5);
    let (mut text, mut positions, mut faces) = (String::new(), Vec::new(), Vec::new());
    for i in 0..120_000u32 {
        let p = [f64::from(i), f64::from(random.below(1000) as u32) / 8.0, -0.5];
        text += &format!("v {} {} {}\n", p[0], p[1], p[2]);
        positions.push(p);
        if i >= 4 && random.below(3) > 0 {
            let n = 3 + random.below(3);
            let corners: Vec<u32> = (0..n).map(|_| random.below(i as usize) as u32).collect();
            text += "f";
            for v in &corners {
                text += &if i % 2 == 0 { format!(" {}", v + 1) } else { format!(" -{}", i + 1 - v) };
            }
            text += "\n";
            faces.extend(fan(&corners));
        }
    }
    assert!(text.len() > 3 << 20);
    let file = Scratch::holding("long.obj", text.as_bytes());
    let scan = Scan::open(&file.path(), &Progress::default()).unwrap();
    for workers in [1, 2, 5] {
        let found = stream(&scan, workers).unwrap();
        assert_eq!((&found.positions, &found.triangles), (&positions, &faces));
    }
    assert_eq!(scan.vertex_error(99_999, String::new()).byte(), text.find("v 99999 ").map(|at| at as u64 + 2));
}

#[test]
fn digits_decide_the_scalar() {
    for (x, scalar) in [("0.1", Scalar::F32), ("500123.456", Scalar::F64), ("0.333333343", Scalar::F32)] {
        let (scan, found) = content("scan.obj", &format!("v {x} 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"));
        assert_eq!(scan.scalar(), scalar, "{x}");
        let x: f64 = x.parse().unwrap();
        assert_eq!(found.positions[0][0], if scalar == Scalar::F32 { f64::from(x as f32) } else { x });
    }
}

#[test]
fn obj_agrees_with_tobj() {
    let mut random = Random(17);
    for turn in 0..60 {
        let n = 3 + random.below(60);
        let mut text = String::new();
        (0..n).for_each(|_| text += &format!("v {} {} 1\n", random.below(99), random.below(99)));
        for _ in 0..1 + random.below(40) {
            let corners = 3 + random.below(3);
            let number = |random: &mut Random| {
                let v = random.below(n) as i64;
                if turn % 2 == 0 { v + 1 } else { v - n as i64 }
            };
            let corners: Vec<String> = (0..corners).map(|_| number(&mut random).to_string()).collect();
            text += &format!("f {}\n", corners.join(" "));
        }
        let options = tobj::LoadOptions { triangulate: true, ..Default::default() };
        let nothing = |_: &std::path::Path| Err(tobj::LoadError::OpenFileFailed);
        let (models, _) = tobj::load_obj_buf(&mut text.as_bytes(), &options, nothing).unwrap();
        let mut oracle = Vec::new();
        for model in &models {
            let at = |i: &u32| model.mesh.positions[3 * *i as usize..][..3].to_vec();
            oracle.extend(model.mesh.indices.iter().map(at));
        }
        let (_, found) = content("scan.obj", &text);
        let ours =
            found.triangles.as_flattened().iter().map(|v| found.positions[*v as usize].map(|x| x as f32).to_vec());
        assert_eq!(ours.collect::<Vec<_>>(), oracle, "turn {turn}");
    }
}

fn off(keyword: &str, behind_vertex: &str, behind_face: &str) -> String {
    let mut text = format!("{keyword}\n# a roof\n\n5 4 8\n");
    ROOF.iter().for_each(|[x, y, z]| text += &format!("{x} {y} {z}{behind_vertex}\n"));
    SIDES.iter().for_each(|s| text += &format!("3  {} {} {}{behind_face}\n", s[0], s[1], s[2]));
    text
}

#[test]
fn off_as_it_comes() {
    let plain = off("OFF", "", "");
    for text in [
        plain.clone(),
        plain.replace('\n', "\r\n"),
        plain.replace("OFF\n# a roof\n\n5 4 8", "# first\nOFF 5 4 8 # counts"),
        plain.replace("OFF\n# a roof\n\n5 4 8", "OFF5 4"),
        plain.replace("1 0 0\n", "1 0 0 # east\n\n# between\n"),
        off("OFF", "", " 255 0 0 128"),
        off("COFF", " 255 0 0 255", ""),
        off("NOFF", " 0 0 1", ""),
        off("STCNOFF", " 0 0 1 0.5 0.5 0.5 1 0 0", " 3"),
        format!("{plain}0 1\n1 2\n"),
    ] {
        let (scan, found) = content("scan.off", &text);
        assert_eq!((scan.format(), scan.scalar()), (Format::OffAscii, Scalar::F32), "{text}");
        assert_eq!((scan.vertex_count(), scan.face_count(), &found.positions[..]), (5, 4, &ROOF[..]), "{text}");
        assert_eq!(found.triangles, triangles(), "{text}");
    }
    assert_eq!(content("scan", &off("NOFF", " 0 0 1", "")).0.attributes()[0].name, "nx");
}

#[test]
fn off_that_is_broken() {
    let plain = off("OFF", "", "");
    for (from, to, what) in [
        ("3  1 2 4", "3  1 5 4", "index 5, but the file has 5 vertices"),
        ("3  1 2 4", "3  1 -1 4", "index -1, but the file has 5 vertices"),
        ("3  1 2 4", "3  1 2", "fewer corners than 3"),
        ("3  1 2 4", "three", "`three`, expected how many corners the face has"),
        ("5 4 8", "6 4 8", "face 3 (byte 93): the file ends before it, but the header counts 6 vertices and 4 faces"),
        ("5 4 8", "5 5 8", "the file ends before it, but the header counts 5 vertices and 5 faces"),
        ("5 4 8", "5 4000000000 8", "need more lines than"),
        ("5 4 8", "5 four", "`four`, expected the counts of vertices, faces and edges"),
        ("5 4 8", "0 4 8", "has no vertex: the header counts 0"),
    ] {
        let told = complaint("scan.off", plain.replacen(from, to, 1).as_bytes());
        assert!(told.contains(what), "{from} -> {to}: {told}");
    }
    assert!(complaint("scan.off", b"OFF\n# nothing\n").contains("has no counts"));
}

#[test]
fn binary_off() {
    let word = |n: i32| n.to_be_bytes();
    let mut bytes = b"OFF BINARY\n".to_vec();
    bytes.extend([5, 5, 8].map(word).concat());
    ROOF.as_flattened().iter().for_each(|x| bytes.extend((*x as f32).to_be_bytes()));
    for (i, side) in SIDES.iter().enumerate() {
        bytes.extend(word(3));
        side.iter().for_each(|v| bytes.extend(word(*v as i32)));
        bytes.extend(word(i as i32));
        (0..i).for_each(|_| bytes.extend(1f32.to_be_bytes()));
    }
    bytes.extend([4, 0, 1, 2, 3, 0].map(word).concat());
    let (scan, found) = read(&Scratch::holding("scan.off", &bytes).path()).unwrap();
    assert_eq!((scan.format(), scan.triangle_count(), scan.trailing_bytes()), (Format::OffBinary, 6, 0));
    assert_eq!((&found.positions[..], &found.triangles[..4]), (&ROOF[..], &triangles()[..]));
    assert_eq!(found.triangles[4..], [[0, 1, 2], [0, 2, 3]]);
    for len in 0..bytes.len() {
        complaint("cut.off", &bytes[..len]);
    }
}
