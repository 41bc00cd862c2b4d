//! The floor: a pass over a scan's faces that does nothing that could be left out.

use super::map::Input;
use super::ply::Ply;
use super::{Body, Crew, Scan};
use crate::error::{Error, Result};
use glam::Vec3;

/// A vertex of three floats, and a face of a count and three indices: what scanners write, and `synth`.
const VERTEX_BYTES: usize = 12;
const FACE_BYTES: usize = 13;

impl Scan {
    /// The area of all faces by the shortest way there is: every position is looked up in the mapped file, which is resident
    /// as a whole. It tells what the machine can do at best; nothing else uses it. `None` where the file is not binary
    /// PLY of this machine's byte order with three floats a vertex and triangles only.
    pub fn mapped_area(&self, crew: &Crew<'_>) -> Result<Option<f64>> {
        match &self.body {
            Body::Ply(ply) => mapped_area(ply, &self.input, crew),
            _ => Ok(None),
        }
    }
}

fn mapped_area(ply: &Ply, input: &Input, crew: &Crew<'_>) -> Result<Option<f64>> {
    let (Some((vertices, record)), Some((faces, triangle))) = (&ply.vertex_run, &ply.triangle_run) else {
        return Ok(None);
    };
    let floats = record.axes.map(|(offset, kind)| (offset, kind.bytes())) == [(0, 4), (4, 4), (8, 4)];
    let little = !record.big && !triangle.big && cfg!(target_endian = "little");
    let plain = floats && little && (triangle.offset, triangle.count.bytes()) == (0, 1);
    if !plain || (vertices.stride, faces.stride) != (VERTEX_BYTES, FACE_BYTES) || !ply.fits_f32() {
        return Ok(None);
    }
    let window = input.window(vertices.offset, vertices.count as usize * VERTEX_BYTES)?;
    let positions = window.as_chunks::<VERTEX_BYTES>().0;
    let at = |corner: &[u8]| {
        let index: u32 = bytemuck::pod_read_unaligned(corner);
        positions.get(index as usize).map(|bytes| Vec3::from_array(bytemuck::pod_read_unaligned(bytes)))
    };
    let sums = faces.pump(
        input,
        crew,
        || 0.0,
        |sum, first, chunk| {
            for (i, face) in chunk.as_chunks::<FACE_BYTES>().0.iter().enumerate() {
                let (Some(a), Some(b), Some(c)) = (at(&face[1..5]), at(&face[5..9]), at(&face[9..13])) else {
                    let what = format!("face {} has a vertex that is not there", first + i as u64);
                    return Err(Error::input(input.path(), what));
                };
                *sum += f64::from(0.5 * (b - a).cross(c - a).length());
            }
            Ok(())
        },
    )?;
    Ok(Some(sums.into_iter().sum()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Progress;

    #[test]
    fn the_area_is_that_of_the_faces_and_other_files_are_passed_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("scan.ply");
        let head = "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\n\
                    property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n";
        let mut bytes = head.as_bytes().to_vec();
        for x in [[0f32, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 3.0, 0.0], [0.0, 3.0, 0.0]].as_flattened() {
            bytes.extend(x.to_le_bytes());
        }
        for corners in [[0u32, 1, 2], [0, 2, 3]] {
            bytes.push(3);
            corners.iter().for_each(|corner| bytes.extend(corner.to_le_bytes()));
        }
        std::fs::write(&path, &bytes).unwrap();
        let area = |path: &std::path::Path, workers| {
            let progress = Progress::default();
            let scan = Scan::open(path, &progress).unwrap();
            scan.mapped_area(&Crew { workers, progress: &progress }).map_err(|error| error.to_string())
        };
        assert_eq!((area(&path, 1), area(&path, 2)), (Ok(Some(6.0)), Ok(Some(6.0))));
        *bytes.last_mut().unwrap() = 1;
        std::fs::write(&path, &bytes).unwrap();
        assert!(area(&path, 1).unwrap_err().contains("face 1 has a vertex that is not there"));
        let text = folder.path().join("text.obj");
        std::fs::write(&text, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
        assert_eq!(area(&text, 1), Ok(None));
    }
}
