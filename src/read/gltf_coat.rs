//! What vertices of glTF carry: colours, texture coordinates, normals; what faces belong to is in `gltf_looks`.
//!
//! Files split vertices where these break off; those that lie at one place are told apart as wedges again (`carry`).

use super::gltf::{Cloud, Gltf, Numbers};
use super::gltf_json::TextureTransform;
use super::gltf_looks::patches;
use super::map::Input;
use super::stream::{CHUNK, Crew};
use super::{CarriedChunk, CarriedStep, TriangleChunk};
use crate::error::Result;
use crate::mesh::coat::{Coat, Corners, NOTHING};
use crate::mesh::columns::{Column, Meaning, Number};
use crate::progress::Progress;
use glam::DVec3;
use std::sync::{Mutex, PoisonError};

/// Numbers of a cloud's vertices beside their positions, as many as there are positions.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Extras {
    pub texture: Option<Numbers>,
    /// How texture coordinates are turned and moved.
    pub turned: Option<TextureTransform>,
    pub normal: Option<Numbers>,
    pub colour: Option<Numbers>,
}

impl Gltf {
    /// Numbers that vertices carry: colours, if all of them have some.
    pub fn columns(&self) -> Vec<Column> {
        if self.clouds.is_empty() || self.clouds.iter().any(|cloud| cloud.extras.colour.is_none()) {
            return Vec::new();
        }
        let column = |name: &str| Column { name: name.into(), number: Number::U8, meaning: Meaning::of(name) };
        ["red", "green", "blue"].map(column).to_vec()
    }

    /// Whether there is anything else that vertices carry.
    pub fn is_coated(&self) -> bool {
        let has = |cloud: &Cloud| cloud.extras.texture.is_some() || cloud.extras.normal.is_some();
        self.clouds.iter().any(has) || !self.looks.is_plain()
    }

    /// Streams the vertices with their colours.
    pub fn carried(&self, input: &Input, crew: &Crew<'_>, step: &CarriedStep<'_>) -> Result<()> {
        let (mut positions, mut values) = (Vec::new(), Vec::new());
        for cloud in &self.clouds {
            let Some(colour) = &cloud.extras.colour else { continue };
            let mut done = 0;
            while done < cloud.numbers.count {
                crew.progress.check()?;
                let some = (CHUNK as u64).min(cloud.numbers.count - done);
                positions.clear();
                values.clear();
                let window = cloud.numbers.window(self.input(input, &cloud.numbers), done, some, 3)?;
                cloud.decode(&window, &mut positions);
                let window = colour.window(self.input(input, colour), done, some, 3)?;
                // glTF has colours as light adds up, scans as screens show them.
                colour.each::<3>(&window, |rgb| values.extend(rgb.map(|x| (255.0 * shown(x)).round())));
                step(
                    0,
                    CarriedChunk { first: cloud.first + done, positions: &positions, values: &values, columns: 3 },
                )?;
                done += some;
            }
            crew.progress.add(cloud.numbers.count * cloud.numbers.stride as u64);
        }
        Ok(())
    }

    /// Values of all vertices.
    pub fn coat(&self, input: &Input, progress: &Progress) -> Result<Coat> {
        let looks = &self.looks;
        let mut coat = Coat {
            patches: patches(&self.patches).0,
            materials: looks.names.clone(),
            looks: looks.looks.clone(),
            pictures: looks.pictures.clone(),
            lost: looks.lost.clone(),
            groups: looks.groups.clone(),
            ..Coat::default()
        };
        let has = |of: fn(&Cloud) -> Option<Numbers>| self.clouds.iter().any(|cloud| of(cloud).is_some());
        let [textured, smooth] = [has(|cloud| cloud.extras.texture), has(|cloud| cloud.extras.normal)];
        for cloud in &self.clouds {
            let turn = cloud.transform.map(|t| t.matrix3.inverse().transpose());
            let mut done = 0;
            while done < cloud.numbers.count {
                progress.check()?;
                let some = (CHUNK as u64).min(cloud.numbers.count - done);
                match &cloud.extras.texture {
                    Some(numbers) => {
                        let window = numbers.window(self.input(input, numbers), done, some, 2)?;
                        numbers.each::<2>(&window, |uv| {
                            let [s, t] = cloud.extras.turned.map_or(uv, |turned| turned.apply(uv));
                            coat.uvs.push([s as f32, (1.0 - t) as f32]);
                        });
                    }
                    None if textured => coat.uvs.extend((0..some).map(|_| [f32::NAN; 2])),
                    None => {}
                }
                match &cloud.extras.normal {
                    Some(numbers) => {
                        let window = numbers.window(self.input(input, numbers), done, some, 3)?;
                        numbers.each::<3>(&window, |n| {
                            let n = DVec3::from_array(n);
                            let n = turn.map_or(n, |turn| (turn * n).normalize_or_zero());
                            coat.normals.push(n.as_vec3().to_array());
                        });
                    }
                    None if smooth => coat.normals.extend((0..some).map(|_| [f32::NAN; 3])),
                    None => {}
                }
                done += some;
            }
        }
        Ok(coat)
    }

    /// Triangles, in the order of the file.
    pub fn corners(
        &self,
        coat: &Coat,
        input: &Input,
        progress: &Progress,
        step: &mut (dyn FnMut(Corners) + Send),
    ) -> Result<()> {
        let step = Mutex::new(step);
        let (_, of_patches) = patches(&self.patches);
        self.triangles(input, &Crew { workers: 1, progress }, &|_, chunk: TriangleChunk<'_>| {
            let mut step = step.lock().unwrap_or_else(PoisonError::into_inner);
            // A chunk is of one primitive.
            let primitive = self.patches.partition_point(|patch| patch.first <= chunk.first);
            let patch = primitive.checked_sub(1).map_or(0, |i| of_patches[i]);
            for vertices in chunk.triangles {
                let of = |there: bool| if there { *vertices } else { [NOTHING; 3] };
                let (uvs, normals) = (of(!coat.uvs.is_empty()), of(!coat.normals.is_empty()));
                step(Corners { vertices: *vertices, uvs, normals, patch });
            }
            Ok(())
        })
    }
}

/// The colour's part that a share of light is (sRGB).
pub(super) fn shown(light: f64) -> f64 {
    let light = light.clamp(0.0, 1.0);
    if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}
