//! Seeded mutations of small files of every format: whatever the bytes, an answer in one line, and little memory.

use super::compressed::packed;
use super::gltf_files;
use super::write::*;
use super::{Random, peak_mib, stream, told};
use meshmill::Result;
use meshmill::progress::Progress;
use meshmill::read::{Crew, Scan, load};
use meshmill::scratch::Scratch;
use std::path::Path;

const TURNS: usize = 6_000;

fn seeds() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    let mixed = [vertices(&ROOF), faces(&[&[0, 1, 2, 3], SIDES[0], &[], &[1, 2], SIDES[1]])];
    let mut listed = roof();
    listed[0].properties.push(("list", Type::List("short", "double")));
    listed[0].records.iter_mut().for_each(|r| r.push(Value::List(vec![1.0, 2.0])));
    listed[1].properties[0].1 = Type::List("int", "uint");
    listed[1].properties.insert(0, ("texcoord", Type::List("uchar", "float")));
    listed[1].records.iter_mut().for_each(|r| r.insert(0, Value::List(vec![0.0; 6])));
    for encoding in ENCODINGS {
        seeds.push(ply(encoding, &roof()));
        seeds.push(ply(encoding, &mixed));
        seeds.push(ply(encoding, &listed));
        seeds.push(ply(encoding, &[faces(&SIDES), vertices(&ROOF)]));
    }
    seeds.push(binary_stl(b"solid", &roof_soup()));
    seeds.push(ascii_stl("roof", &roof_soup()).into_bytes());
    let mut obj = String::from("mtllib a.mtl\no roof\n");
    ROOF.iter().for_each(|[x, y, z]| obj += &format!("v {x} {y} {z}\n"));
    SIDES.iter().for_each(|s| obj += &format!("f {}/1 {}//2 -{}\n", s[0] + 1, s[1] + 1, 5 - s[2]));
    seeds.push(obj.into_bytes());
    let mut off = String::from("COFF\n5 4 0\n");
    ROOF.iter().for_each(|[x, y, z]| off += &format!("{x} {y} {z} 1 0 0 1\n"));
    SIDES.iter().for_each(|s| off += &format!("3 {} {} {}\n", s[0], s[1], s[2]));
    seeds.push(off.into_bytes());
    seeds.push(gltf_files::roof().glb());
    seeds.push(gltf_files::roof().embedded().into_bytes());
    seeds.push(packed(true, &ply(Encoding::Little, &roof())));
    seeds.push(packed(false, &binary_stl(b"", &roof_soup())));
    seeds
}

fn mutate(random: &mut Random, bytes: &mut Vec<u8>) {
    const WORDS: [&[u8]; 22] = [
        b"4294967296",
        b"18446744073709551615",
        b"-1",
        b"1e308",
        b"nan",
        b"inf",
        b"\n",
        b" ",
        b"end_header\n",
        b"list ",
        b"double",
        b"element face 3\n",
        b"property uchar q\n",
        b"\xff\xff\xff\xff",
        b"\0\0\0\0",
        b"endsolid\nsolid\n",
        b"\nf -1 -2 -3\n",
        b"\\\n",
        b"OFF BINARY\n",
        b"\"byteStride\":4,",
        b"\"mode\":5,",
        b"\"children\":[0],",
    ];
    for _ in 0..1 + random.below(2) {
        if bytes.is_empty() {
            return;
        }
        let at = random.below(bytes.len());
        let len = (1 + random.below(12)).min(bytes.len() - at);
        match random.below(8) {
            0 => bytes[at] ^= 1 << random.below(8),
            1 => bytes[at] = random.draw() as u8,
            2 => drop(bytes.drain(at..at + len)),
            3 => bytes.truncate(at),
            4 => {
                let copy = bytes[at..at + len].to_vec();
                bytes.splice(at..at, copy);
            }
            5 => drop(bytes.splice(at..at + len, random.pick(&WORDS).iter().copied())),
            6 => drop(bytes.splice(at..at, random.pick(&WORDS).iter().copied())),
            _ => {
                // Where the number stands in the file: the most likely place for something to go wrong.
                let digits: Vec<usize> = (0..bytes.len()).filter(|i| bytes[*i].is_ascii_digit()).collect();
                if !digits.is_empty() {
                    bytes[*random.pick(&digits)] = b'0' + random.below(10) as u8;
                }
            }
        }
    }
}

/// Everything that can be asked of a scan.
fn use_all(path: &Path, workers: usize) -> Result<()> {
    let progress = Progress::default();
    let crew = Crew { workers, progress: &progress };
    let folder = path.parent().unwrap();
    let scratch = Scratch::in_folder(folder).with_quota(1 << 24).with_memory(1 << 24);
    let scan = Scan::open_in(path, &scratch, &progress)?;
    let content = stream(&scan, workers)?;
    let sample = scan.sample(&crew, 100)?;
    assert!(sample.triangles.len() <= content.triangles.len() + content.soup.len());
    let (mesh, _, report) = load::<f64>(&scan, &crew, u64::MAX)?.unwrap();
    assert!(mesh.faces.as_flattened().iter().all(|v| (*v as usize) < mesh.positions.len()));
    assert!(mesh.positions.as_flattened().iter().all(|x| x.is_finite()));
    assert_eq!(mesh.faces.len() as u64 + report.repeated_corner_faces, scan.triangle_count());
    Ok(())
}

#[test]
fn no_bytes_do_harm() {
    let (seeds, mut random) = (seeds(), Random(2026));
    let file = super::Scratch::new("mutant.stl");
    let (mut read, mut refused) = (0, 0);
    for turn in 0..TURNS {
        let mut bytes = seeds[turn % seeds.len()].clone();
        mutate(&mut random, &mut bytes);
        file.put(&bytes);
        match use_all(&file.path(), 1 + turn % 2) {
            Ok(()) => read += 1,
            Err(error) => {
                told(&error, &file.path());
                refused += 1;
            }
        }
    }
    assert!(read > TURNS / 20 && refused > TURNS / 20, "{read} read, {refused} refused");
    assert!(peak_mib() < 128, "{} MiB", peak_mib());
}
