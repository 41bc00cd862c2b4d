//! The one PLY that the peers speak: binary little-endian, float positions, triangles.

use std::fs::File;
use std::io::{BufWriter, Read, Result, Write};
use std::path::Path;

/// Positions and triangles as a file has them: nothing is welded, dropped or put in order.
#[derive(Default)]
pub struct Mesh {
    pub positions: Vec<[f32; 3]>,
    /// Three a face.
    pub indices: Vec<u32>,
}

/// A face's record: the count of corners, then the corners.
const FACE_BYTES: usize = 13;
/// Faces that are read or written at a time, so that no copy of the file is held.
const BLOCK: usize = 1 << 16;

pub fn read(path: &Path) -> Result<Mesh> {
    let file = File::open(path)?;
    let size = file.metadata()?.len();
    let mut head = Vec::new();
    (&file).take(1 << 16).read_to_end(&mut head)?;
    const END: &[u8] = b"end_header\n";
    let end = head.windows(END.len()).position(|w| w == END).ok_or_else(|| bad("no PLY header with \\n line ends"))?;
    let body = end + END.len();
    let (vertices, faces) = counts(&head[..end])?;
    let expected = 12 * vertices as u128 + FACE_BYTES as u128 * faces as u128 + body as u128;
    if u128::from(size) != expected {
        return Err(bad(&format!("{size} bytes, but the header promises {expected}")));
    }

    let mut rest = (&head[body..]).chain(file);
    let mut mesh = Mesh { positions: bytemuck::zeroed_vec(vertices), indices: Vec::with_capacity(3 * faces) };
    rest.read_exact(bytemuck::cast_slice_mut(&mut mesh.positions))?;
    let mut block = vec![0; BLOCK * FACE_BYTES];
    for first in (0..faces).step_by(BLOCK) {
        let block = &mut block[..BLOCK.min(faces - first) * FACE_BYTES];
        rest.read_exact(block)?;
        for face in block.as_chunks::<FACE_BYTES>().0 {
            if face[0] != 3 {
                return Err(bad("a face that is no triangle"));
            }
            let corners = face[1..].as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b));
            mesh.indices.extend(corners);
        }
    }
    if mesh.indices.iter().any(|&v| v as usize >= vertices) {
        return Err(bad("a corner that is no vertex"));
    }
    Ok(mesh)
}

/// Vertices and faces of a header in the one form that is understood.
fn counts(header: &[u8]) -> Result<(usize, usize)> {
    let text = std::str::from_utf8(header).map_err(|_| bad("a header that is not UTF-8"))?;
    let lines: Vec<&str> = text.lines().filter(|l| !l.starts_with("comment") && !l.starts_with("obj_info")).collect();
    let expected =
        "expected `ply`, binary little-endian, vertices of float x, y, z alone, faces of one list uchar (u)int";
    let ["ply", "format binary_little_endian 1.0", vertices, x, y, z, faces, list] = lines[..] else {
        return Err(bad(expected));
    };
    let floats = [(x, "x"), (y, "y"), (z, "z")]
        .iter()
        .all(|(line, name)| ["float", "float32"].iter().any(|t| *line == format!("property {t} {name}")));
    let list: Vec<&str> = list.split(' ').collect();
    let lists = matches!(list[..], ["property", "list", "uchar" | "uint8", "int" | "uint" | "int32" | "uint32", _]);
    let count = |line: &str, element| line.strip_prefix(element).and_then(|n| n.parse::<u32>().ok());
    match (count(vertices, "element vertex "), count(faces, "element face ")) {
        (Some(v), Some(f)) if floats && lists => Ok((v as usize, f as usize)),
        _ => Err(bad(expected)),
    }
}

pub fn write(path: &Path, mesh: &Mesh) -> Result<()> {
    let mut out = BufWriter::with_capacity(1 << 20, File::create(path)?);
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         element face {}\nproperty list uchar uint vertex_indices\nend_header\n",
        mesh.positions.len(),
        mesh.indices.len() / 3
    )?;
    out.write_all(bytemuck::cast_slice(&mesh.positions))?;
    for face in mesh.indices.as_chunks::<3>().0 {
        out.write_all(&[3])?;
        out.write_all(bytemuck::cast_slice(face))?;
    }
    // As durable as what it is compared with.
    out.into_inner()?.sync_all()
}

fn bad(what: &str) -> std::io::Error {
    std::io::Error::new(std::io::ErrorKind::InvalidData, what)
}
