//! The same files through other people's readers.

use super::write::*;
use super::{Random, Scratch, read};
use meshmill::progress::Progress;
use meshmill::read::{Crew, Scan, load};
use ply_rs::parser::Parser;
use ply_rs::ply::{DefaultElement, Property};

const INTEGERS: [&str; 6] = ["uchar", "short", "ushort", "int", "uint", "int32"];

/// Elements of random shape.
fn any_scan(random: &mut Random) -> Vec<Element> {
    let n = 1 + random.below(120);
    let mut vertex = Element { name: "vertex", properties: Vec::new(), records: vec![Vec::new(); n] };
    for name in ["x", "a", "z", "y", "b"] {
        let kind = ["float", "double", "float", "short", "int"][random.below(5)];
        let list = name == "a" && random.below(2) == 0;
        vertex.properties.push((name, if list { Type::List("uchar", "float") } else { Type::One(kind) }));
        for record in &mut vertex.records {
            let x = (random.draw() % 20_001) as f64 / 64.0 - 100.0;
            let x = if kind.len() > 5 || kind == "float" { stored(kind, x / 3.0) } else { x.trunc() };
            record.push(if list { Value::List(vec![0.5; random.below(4)]) } else { Value::One(x) });
        }
    }
    let (most, triangles) = (2 + random.below(5), random.below(2) == 0);
    let corners = |random: &mut Random| {
        let len = if triangles { 3 } else { random.below(most + 2) };
        (0..len).map(|_| random.below(n.min(250)) as f64).collect()
    };
    let name = ["vertex_indices", "vertex_index"][random.below(2)];
    let list = Type::List(INTEGERS[random.below(6)], INTEGERS[random.below(6)]);
    let mut face = Element { name: "face", properties: vec![(name, list)], records: Vec::new() };
    let before = random.below(2) == 0;
    if before {
        face.properties.insert(0, ("flags", Type::One("uchar")));
    }
    for _ in 0..1 + random.below(150) {
        let mut record = vec![Value::List(corners(random))];
        if before {
            record.insert(0, Value::One(3.0));
        }
        face.records.push(record);
    }
    face.records.push([vec![Value::One(1.0); usize::from(before)], vec![Value::List(vec![0.0; 3])]].concat());
    vec![vertex, face]
}

fn numbers(property: &Property) -> Vec<f64> {
    macro_rules! widen {
        ($($one:ident $list:ident),*) => {
            match property {
                $(Property::$one(x) => vec![f64::from(*x)],
                  Property::$list(x) => x.iter().map(|x| f64::from(*x)).collect(),)*
            }
        };
    }
    widen!(Char ListChar, UChar ListUChar, Short ListShort, UShort ListUShort, Int ListInt, UInt ListUInt,
        Float ListFloat, Double ListDouble)
}

#[test]
fn ply_agrees_with_ply_rs() {
    let mut random = Random(11);
    for turn in 0..150 {
        let encoding = ENCODINGS[turn % 3];
        let bytes = ply(encoding, &any_scan(&mut random));
        let oracle = Parser::<DefaultElement>::new().read_ply(&mut &bytes[..]).unwrap();
        let positions: Vec<[f64; 3]> =
            oracle.payload["vertex"].iter().map(|v| ["x", "y", "z"].map(|axis| numbers(&v[axis])[0])).collect();
        let polygons = oracle.payload["face"].iter().map(|f| {
            let list = f.get("vertex_indices").or_else(|| f.get("vertex_index")).unwrap();
            numbers(list).into_iter().map(|v| v as u32).collect::<Vec<_>>()
        });
        let triangles: Vec<[u32; 3]> = polygons.flat_map(|p| fan(&p)).collect();
        let (_, found) = read(&Scratch::holding("scan.ply", &bytes).path()).unwrap();
        assert_eq!(found.positions, positions, "turn {turn}");
        assert_eq!(found.triangles, triangles, "turn {turn}");
    }
}

#[test]
fn stl_agrees_with_stl_io() {
    let mut random = Random(12);
    for turn in 0..60 {
        let n = 1 + random.below(200);
        let corner = |random: &mut Random| [0; 3].map(|_| f64::from((random.below(7) as f32 - 3.0) / 3.0));
        let soup: Vec<_> = (0..n).map(|_| [0; 3].map(|_| corner(&mut random))).collect();
        let bytes = if turn % 2 == 0 { binary_stl(b"made", &soup) } else { ascii_stl("made", &soup).into_bytes() };
        let oracle = stl_io::create_stl_reader(&mut std::io::Cursor::new(&bytes))
            .unwrap()
            .map(|t| t.unwrap().vertices.map(|v| v.0.map(f64::from)))
            .collect::<Vec<_>>();
        let file = Scratch::holding("scan.stl", &bytes);
        let (scan, found) = read(&file.path()).unwrap();
        assert_eq!(found.soup, oracle);

        let welded = stl_io::read_stl(&mut std::io::Cursor::new(&bytes)).unwrap();
        let whole = welded.faces.iter().filter(|f| {
            let p = f.vertices.map(|v| welded.vertices[v].0);
            p[0] != p[1] && p[1] != p[2] && p[2] != p[0]
        });
        let progress = Progress::default();
        let loaded = load::<f32>(&scan, &Crew { workers: 2, progress: &progress }, u64::MAX);
        let Ok(Some((mesh, frame, report))) = loaded else {
            assert_eq!(whole.count(), 0);
            continue;
        };
        assert_eq!(mesh.faces.len() as u64 + report.repeated_corner_faces, n as u64);
        let expected: Vec<[[f32; 3]; 3]> = whole.map(|f| f.vertices.map(|v| welded.vertices[v].0)).collect();
        let at = |v: u32| mesh.positions[v as usize].map(|x| frame.to_file(x.into()) as f32);
        assert_eq!(mesh.faces.iter().map(|f| f.map(at)).collect::<Vec<_>>(), expected);
    }
}

#[test]
fn reading_past_the_map_samples_what_a_pass_samples() {
    let mut random = Random(13);
    let n = 30_000;
    let positions: Vec<[f64; 3]> = (0..n).map(|i| [f64::from(i), 0.5, if i == 77 { f64::NAN } else { 2.0 }]).collect();
    for scattered in [false, true] {
        let triangle =
            |i: u32| if scattered { [0; 3].map(|_| random.below(n as usize) as u32) } else { [i, i + 1, i + 2] };
        let triangles: Vec<[u32; 3]> = (0..n - 2).map(triangle).collect();
        let polygons: Vec<&[u32]> = triangles.iter().map(|t| &t[..]).collect();
        let elements = [vertices(&positions), faces(&polygons)];
        let sample = |encoding, asked| {
            let file = Scratch::holding("scan.ply", &ply(encoding, &elements));
            let progress = Progress::default();
            let scan = Scan::open(&file.path(), &progress).unwrap();
            scan.sample(&Crew { workers: 2, progress: &progress }, asked).unwrap()
        };
        for asked in [1, 64, 700, 5_000, 100_000] {
            let sampled = sample(Encoding::Little, asked);
            assert_eq!(sampled, sample(Encoding::Ascii, asked));
            let about = asked.clamp(64, triangles.len());
            assert!(sampled.triangles.len() <= about && sampled.triangles.len() + 64 > about);
            let blocks = if scattered { 0.7..1.0 } else { 0.015..0.05 };
            assert!(blocks.contains(&sampled.blocks_per_triangle), "{}", sampled.blocks_per_triangle);
            let wide = if scattered { 0.9..=1.0 } else { 0.0..=0.0 };
            assert!(wide.contains(&sampled.wide_triangles), "{}", sampled.wide_triangles);
        }
    }
    let soup: Vec<_> = positions.iter().map(|p| [[p[0], 1.0, 2.0], [0.0; 3], [3.0; 3]]).collect();
    let sample = |bytes: &[u8], asked| {
        let file = Scratch::holding("scan.stl", bytes);
        let progress = Progress::default();
        let scan = Scan::open(&file.path(), &progress).unwrap();
        scan.sample(&Crew { workers: 2, progress: &progress }, asked).unwrap()
    };
    for asked in [1, 700, 100_000] {
        let sampled = sample(&binary_stl(b"", &soup), asked);
        assert_eq!(sampled, sample(ascii_stl("", &soup).as_bytes(), asked));
        assert_eq!((sampled.blocks_per_triangle, sampled.wide_triangles), (0.0, 0.0));
    }
}
