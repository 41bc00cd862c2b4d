//! A mesh with a number and a colour at each vertex, as binary PLY.

use super::encode::{ply_face, ply_vertex, ply_vertex_double};
use super::{Format, Target};
use crate::error::{Error, Result};
use crate::mesh::{Coordinate, Frame, IndexedMesh, widen};
use crate::progress::{Progress, Stage};

/// What is written at each vertex beside its position.
pub struct Shading<'a> {
    /// The name of the property that holds the number.
    pub property: &'static str,
    /// A number a vertex.
    pub values: &'a [f64],
    /// The colour of a number.
    pub colour: &'a dyn Fn(f64) -> [u8; 3],
}

impl Target {
    /// Refuses a target that cannot hold colours.
    pub fn check_holds_colours(&self) -> Result<()> {
        match self.format() {
            Format::Ply => Ok(()),
            _ => Err(Error::usage(format!(
                "{}: a heat map needs colours, which only a binary .ply gets",
                self.path().display()
            ))),
        }
    }

    /// Writes `mesh` in the file's units, shaded, and puts it in the target's place; the number of bytes.
    pub fn write_shaded<S: Coordinate>(
        self,
        mesh: &IndexedMesh<S>,
        frame: Frame,
        shading: &Shading,
        progress: &Progress,
    ) -> Result<u64> {
        self.check_holds_colours()?;
        let scalar = if S::DOUBLE { "double" } else { "float" };
        let header = format!(
            "ply\nformat binary_little_endian 1.0\ncomment meshmill {}\n\
             element vertex {}\nproperty {scalar} x\nproperty {scalar} y\nproperty {scalar} z\n\
             property {scalar} {}\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
             element face {}\nproperty list uchar int vertex_indices\nend_header\n",
            env!("CARGO_PKG_VERSION"),
            mesh.positions.len(),
            shading.property,
            mesh.faces.len()
        );
        let vertex_bytes = if S::DOUBLE { 35 } else { 19 };
        progress.begin(Stage::Write, mesh.positions.len() as u64 * vertex_bytes + mesh.faces.len() as u64 * 13);
        self.write_by(progress, |sink| {
            sink.put(header.as_bytes())?;
            let mut record = Vec::with_capacity(vertex_bytes as usize);
            for (p, value) in mesh.positions.iter().zip(shading.values) {
                let [x, y, z] = frame.place_back(widen(*p)).to_array();
                record.clear();
                if S::DOUBLE {
                    record.extend(ply_vertex_double([x, y, z]));
                    record.extend(value.to_le_bytes());
                } else {
                    record.extend(ply_vertex([x as f32, y as f32, z as f32]));
                    record.extend((*value as f32).to_le_bytes());
                }
                record.extend((shading.colour)(*value));
                sink.put(&record)?;
            }
            sink.put_each(&mesh.faces, |face| Ok(ply_face(*face)))
        })
    }
}
