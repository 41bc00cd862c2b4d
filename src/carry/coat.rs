//! The coat of a scan that fits the budget: texture coordinates, normals of corners, materials, groups.
//!
//! Corners of the scan that agree at a vertex are one wedge; the collapse holds the seams between different ones and says
//! what became of each. The result is then split where its vertices have several, which no walk over it can cross: every
//! wedge of the scan looks for its place from where it has gone, on its own side of all seams, and the result's wedges
//! are solved for by least squares like what vertices carry. Texture coordinates stay within the range of their chart,
//! normals are made unit.
//!
//! **Memory** ([`bytes`]): 12 bytes a face, 16 a vertex, 36 a wedge, and 32 in a hash table while it is put on.

use super::solve::{LITTLE_SMOOTHING, Sums};
use super::{Places, Range, SAMPLES, weights};
use crate::cores::InPieces;
use crate::error::Result;
use crate::mesh::adjacency::{Stars, parts};
use crate::mesh::coat::{Coat, Corners, Dress, NOTHING, Patch};
use crate::mesh::columns::{Column, Columns, Meaning, Number};
use crate::mesh::triangle::nearest_on_triangle;
use crate::mesh::{Coordinate, Frame, IndexedMesh, Shades, Wedges, widen};
use crate::progress::{Progress, Stage};
use crate::read::{Crew, Scan};
use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::sync::{Mutex, PoisonError};

/// Where normals give more wedges than this for each vertex, faces are shaded flat: that is no seam to hold, but what the
/// shape says anyway.
const MOST_BY_NORMALS: f64 = 1.5;

/// Where labels would differ across a larger share of the result's edges than this, they are not held: there would be
/// nothing but borders. Faces vote for them instead (`votes`). Of the bunny with regions of various sizes, by the share
/// that was to be expected, E_avg against that without labels:
///
/// | to 1,600 | 0.12 | 0.29 | 0.57 | 0.90 |
/// |---|--:|--:|--:|--:|
/// | | 1.7 | 4.4 | 69 | 18, and seams give way |
///
/// | to 6,945 | 0.06 | 0.14 | 0.27 | 0.43 | 0.67 |
/// |---|--:|--:|--:|--:|--:|
/// | | 1.6 | 2.5 | 5.4 | 13 | 35, and seams give way |
const MOST_BORDERS: f64 = 0.25;

/// Faces that are asked for it.
const ASKED_FOR_BORDERS: usize = 50_000;

/// Bytes that a coat takes for so many wedges and faces, while it is put on and after.
pub const fn bytes(faces: u64, wedges: u64, vertices: u64) -> u64 {
    12 * faces + wedges * (16 + 20 + 32) + 16 * vertices
}

/// A scan's coat while it is reduced.
#[derive(Debug)]
pub struct Worn<S> {
    /// Names, and what faces belong to.
    pub coat: Coat,
    /// Whether normals were left out, since every face has its own.
    pub shaded_flat: bool,
    columns: Vec<Column>,
    /// Where each wedge of the scan is.
    positions: Vec<[S; 3]>,
    /// Its numbers.
    values: Vec<f32>,
    /// What it belongs to.
    patches: Vec<u32>,
}

/// Finds the wedges of a loaded scan of which so many faces are asked for. `None` where its corners carry nothing.
pub fn put_on<S: Coordinate>(
    scan: &Scan,
    mesh: &IndexedMesh<S>,
    frame: Frame,
    asked: Option<u64>,
    crew: &Crew<'_>,
) -> Result<Option<(Worn<S>, Wedges)>> {
    let Some(mut coat) = scan.coat(crew.progress)? else { return Ok(None) };
    let vertices = vertices(scan, mesh, frame, crew)?;
    let mut found = find(scan, mesh, &coat, &vertices, false, crew)?;
    // Borders shrink as edges grow.
    let faces = mesh.faces.len() as f64;
    let fewer = asked.map_or(1.0, |asked| (faces / asked.max(1) as f64).max(1.0));
    if borders(mesh, &coat, &found) * fewer.sqrt() > MOST_BORDERS {
        coat.face_columns.clear();
        // Which texture a face has is no noise: there are no other materials where numbers of faces are labels.
        coat.patches = vec![Patch { material: coat.patches[0].material, ..Patch::default() }];
        if coat.uvs.is_empty() && coat.normals.is_empty() {
            return Ok(None);
        }
        found = find(scan, mesh, &coat, &vertices, false, crew)?;
    }
    let is_flat = |found: &Found| found.keys.len() as f64 > MOST_BY_NORMALS * mesh.positions.len() as f64;
    let shaded_flat = !coat.normals.is_empty() && is_flat(&found) && {
        let without = find(scan, mesh, &coat, &vertices, true, crew)?;
        let is = !is_flat(&without);
        if is {
            found = without;
        }
        is
    };
    drop(vertices);
    let Found { corners, keys } = found;
    if corners.len() != mesh.faces.len() {
        return Ok(None);
    }
    let has_uvs = !coat.uvs.is_empty();
    let has_normals = !coat.normals.is_empty() && !shaded_flat;
    let column = |name: &str, meaning| Column { name: name.into(), number: Number::F32, meaning };
    let uvs = [("s", Meaning::Texture(0)), ("t", Meaning::Texture(1))];
    let normals = [("nx", Meaning::Normal(0)), ("ny", Meaning::Normal(1)), ("nz", Meaning::Normal(2))];
    let columns: Vec<Column> = (uvs.into_iter().filter(|_| has_uvs))
        .chain(normals.into_iter().filter(|_| has_normals))
        .map(|(name, meaning)| column(name, meaning))
        .collect();
    let mut values = Vec::with_capacity(keys.len() * columns.len());
    for key in &keys {
        if has_uvs {
            values.extend(coat.uvs.get(key.uv as usize).copied().unwrap_or([f32::NAN; 2]));
        }
        if has_normals {
            values.extend(coat.normals.get(key.normal as usize).copied().unwrap_or([f32::NAN; 3]));
        }
    }
    let positions = keys.iter().map(|key| mesh.positions[key.vertex as usize]).collect();
    let patches = keys.iter().map(|key| key.patch).collect();
    (coat.uvs, coat.normals) = (Vec::new(), Vec::new());
    let wedges = Wedges { corners, becomes: (0..keys.len() as u32).collect() };
    Ok(Some((Worn { coat, shaded_flat, columns, positions, values, patches }, wedges)))
}

/// The share of the edges between faces of which the labels differ, of a number of faces that tells it.
fn borders<S: Coordinate>(mesh: &IndexedMesh<S>, coat: &Coat, found: &Found) -> f64 {
    if coat.face_columns.is_empty() || coat.patches.len() < 2 || found.corners.len() != mesh.faces.len() {
        return 0.0;
    }
    let patch = |f: usize| found.keys[found.corners[f][0] as usize].patch;
    let mut stars = Stars::default();
    stars.rebuild(&mesh.faces, mesh.positions.len());
    let (mut edges, mut borders) = (0.0, 0.0);
    for f in (0..mesh.faces.len()).step_by(mesh.faces.len().div_ceil(ASKED_FOR_BORDERS).max(1)) {
        let [a, b, c] = mesh.faces[f];
        for edge in [(a, b), (b, c), (c, a)] {
            let Some(other) = stars.across(&mesh.faces, f, edge) else { continue };
            edges += 1.0;
            borders += f64::from(patch(f) != patch(other));
        }
    }
    if edges > 0.0 { borders / edges } else { 0.0 }
}

/// For each vertex of the file the one of the mesh, or [`NOTHING`].
fn vertices<S: Coordinate>(scan: &Scan, mesh: &IndexedMesh<S>, frame: Frame, crew: &Crew<'_>) -> Result<Vec<u32>> {
    let places = Places::of(mesh, frame);
    let mut vertices = vec![NOTHING; scan.vertex_count() as usize];
    let all = Mutex::new(&mut vertices);
    scan.vertices(
        &Crew { workers: 1, ..*crew },
        || (),
        |(), chunk| {
            let mut vertices = all.lock().unwrap_or_else(PoisonError::into_inner);
            for (vertex, p) in vertices[chunk.first as usize..].iter_mut().zip(chunk.positions) {
                *vertex = places.find(*p).unwrap_or(NOTHING);
            }
            Ok(())
        },
    )?;
    Ok(vertices)
}

/// What makes a wedge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Key {
    vertex: u32,
    uv: u32,
    normal: u32,
    patch: u32,
}

struct Found {
    corners: Vec<[u32; 3]>,
    keys: Vec<Key>,
}

fn find<S: Coordinate>(
    scan: &Scan,
    mesh: &IndexedMesh<S>,
    coat: &Coat,
    vertices: &[u32],
    without_normals: bool,
    crew: &Crew<'_>,
) -> Result<Found> {
    let uvs = firsts(coat.uvs.iter().map(|uv| uv.map(plain)));
    let normals = firsts(coat.normals.iter().map(|n| n.map(plain)));
    let first = |of: &[u32], i: u32| of.get(i as usize).copied().unwrap_or(NOTHING);
    let mut numbers: FxHashMap<Key, u32> = FxHashMap::default();
    let mut found = Found { corners: Vec::with_capacity(mesh.faces.len()), keys: Vec::new() };
    scan.corners(coat, crew.progress, &mut |all: Corners| {
        let face = all.vertices.map(|v| vertices[v as usize]);
        // As they were dropped when the scan was loaded.
        let whole = !face.contains(&NOTHING) && face[0] != face[1] && face[1] != face[2] && face[2] != face[0];
        if !whole || mesh.faces.get(found.corners.len()) != Some(&face) {
            return;
        }
        let wedge = |i: usize| {
            let normal = if without_normals { NOTHING } else { first(&normals, all.normals[i]) };
            let key = Key { vertex: face[i], uv: first(&uvs, all.uvs[i]), normal, patch: all.patch };
            *numbers.entry(key).or_insert_with(|| {
                found.keys.push(key);
                found.keys.len() as u32 - 1
            })
        };
        let corners = [0, 1, 2].map(wedge);
        found.corners.push(corners);
    })?;
    Ok(found)
}

/// The bits of a number; both zeros are one.
fn plain(x: f32) -> u32 {
    (x + 0.0).to_bits()
}

/// For each value the first that is the same.
fn firsts<const N: usize>(values: impl ExactSizeIterator<Item = [u32; N]>) -> Vec<u32> {
    let mut seen = FxHashMap::default();
    values.enumerate().map(|(i, value)| *seen.entry(value).or_insert(i as u32)).collect()
}

impl<S: Coordinate> Worn<S> {
    /// What it carries, by name.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// Bytes that it takes.
    pub fn bytes(&self) -> u64 {
        let wedge = size_of::<[S; 3]>() + size_of::<u32>() + size_of::<f32>() * self.columns.len();
        (self.positions.len() * wedge) as u64
    }

    /// How many wedges the scan has.
    pub fn wedges(&self) -> usize {
        self.positions.len()
    }

    /// Texture coordinates and normals that are to steer, a whole texture as the first length, from one normal to its
    /// opposite as the second; with them what vertices have already.
    pub fn shades(
        &self,
        wedges: &Wedges,
        faces: &[[u32; 3]],
        of_vertices: &Shades,
        [texture, normal]: [f64; 2],
    ) -> Shades {
        let length = |c: usize| match self.columns[c].meaning {
            Meaning::Texture(_) => texture,
            Meaning::Normal(_) => 0.5 * normal,
            _ => 0.0,
        };
        let own: Vec<(usize, f32)> = (0..self.columns.len()).map(|c| (c, length(c) as f32)).collect();
        let own: Vec<(usize, f32)> = own.into_iter().filter(|(_, length)| *length > 0.0).collect();
        let dims = own.len() + of_vertices.dims;
        let mut values = vec![0.0f32; dims * self.positions.len()];
        let n = self.columns.len();
        for (face, corners) in faces.iter().zip(&wedges.corners) {
            for (vertex, wedge) in face.iter().zip(corners) {
                let mine = &mut values[*wedge as usize * dims..][..dims];
                for (x, (c, length)) in mine.iter_mut().zip(&own) {
                    let value = length * self.values[*wedge as usize * n + c];
                    *x = if value.is_finite() { value } else { 0.0 };
                }
                if of_vertices.dims > 0 {
                    mine[own.len()..].copy_from_slice(of_vertices.of(*vertex));
                }
            }
        }
        Shades { dims, values }
    }

    /// Solves for what the wedges of a result get.
    pub fn dress(&self, mesh: &IndexedMesh<S>, wedges: &Wedges, progress: &Progress) -> Result<Dress> {
        progress.begin(Stage::Carry, self.positions.len() as u64);
        let mut numbers = vec![NOTHING; wedges.becomes.len()];
        let mut dress = Dress::default();
        for (face, corners) in mesh.faces.iter().zip(&wedges.corners) {
            for (vertex, wedge) in face.iter().zip(corners) {
                let number = &mut numbers[*wedge as usize];
                if *number == NOTHING {
                    *number = dress.vertices.len() as u32;
                    dress.vertices.push(*vertex);
                }
            }
            dress.corners.push(corners.map(|wedge| numbers[wedge as usize]));
            dress.patches.push(self.patches[corners[0] as usize]);
        }
        let split = IndexedMesh {
            positions: dress.vertices.iter().map(|v| mesh.positions[*v as usize]).collect(),
            faces: dress.corners.clone(),
        };
        dress.columns = Columns { columns: self.columns.clone(), values: Vec::new() };
        dress.columns.values = self.solve(&split, wedges, &numbers, progress)?;
        super::make_unit(&mut dress.columns);
        Ok(dress)
    }

    fn solve(&self, split: &IndexedMesh<S>, wedges: &Wedges, numbers: &[u32], progress: &Progress) -> Result<Vec<f64>> {
        let (n, count) = (self.columns.len(), split.positions.len());
        let of = |wedge: usize| &self.values[wedge * n..(wedge + 1) * n];
        let mut ranges = vec![Range::NONE; n];
        for wedge in 0..self.positions.len() {
            ranges.iter_mut().zip(of(wedge)).for_each(|(range, x)| range.include(f64::from(*x)));
        }
        let mut stars = Stars::default();
        stars.rebuild(&split.faces, count);
        let islands = islands(&split.faces, count);
        let sums = Sums::of(split.faces.len(), count, n);
        let stride = (self.positions.len() as u64).div_ceil(SAMPLES * count.max(1) as u64).max(1);
        let pick = super::Pick { stride };
        // What no number was given for asks nothing; one that every island needs is never left out.
        let asks = |wedge: usize| {
            let home = numbers[wedges.becomes[wedge] as usize];
            let picked = pick.takes(wedge as u64) || wedges.becomes[wedge] as usize == wedge;
            (picked && home != NOTHING && of(wedge).iter().all(|x| x.is_finite())).then_some(home)
        };
        (0..self.positions.len()).into_par_iter().in_pieces(1024).for_each(|wedge| {
            let Some(home) = asks(wedge) else { return };
            let p = widen(self.positions[wedge]);
            let Some((face, point)) = nearest(split, &stars, home, p) else { return };
            let corners = split.faces[face as usize];
            let mut shares = [0.0; 8];
            shares.iter_mut().zip(of(wedge)).zip(&ranges).for_each(|((s, x), range)| *s = range.share(f64::from(*x)));
            sums.add(face as usize, corners, weights(point, corners.map(|w| split.at(w))), &shares[..n]);
        });
        progress.check()?;
        let mut of_islands = vec![Range::NONE; n * count];
        for wedge in 0..self.positions.len() {
            if let Some(home) = asks(wedge) {
                let ranges = &mut of_islands[islands[home as usize] as usize * n..][..n];
                ranges.iter_mut().zip(of(wedge)).for_each(|(range, x)| range.include(f64::from(*x)));
            }
        }
        let system = sums.into_system(&split.faces, LITTLE_SMOOTHING);
        let mut values = vec![0.0; n * count];
        for c in 0..n {
            progress.check()?;
            for (wedge, x) in system.solve(c).into_iter().enumerate() {
                let own = of_islands[islands[wedge] as usize * n + c];
                let value = ranges[c].unclamped(x);
                values[wedge * n + c] = if own.least <= own.most { value.clamp(own.least, own.most) } else { value };
            }
        }
        Ok(values)
    }
}

/// The place nearest to `p` that is found by walking from a vertex over faces that share vertices: never across a seam.
fn nearest<S: Coordinate>(mesh: &IndexedMesh<S>, stars: &Stars, home: u32, p: DVec3) -> Option<(u32, DVec3)> {
    let mut best: Option<(f64, u32, DVec3)> = None;
    let look = |v: u32, best: &mut Option<(f64, u32, DVec3)>| {
        for &corner in stars.of(v) {
            let f = parts(corner).0;
            let (point, distance_sq) = nearest_on_triangle(p, mesh.faces[f].map(|u| mesh.at(u)));
            if best.is_none_or(|b| (distance_sq, f as u32) < (b.0, b.1)) {
                *best = Some((distance_sq, f as u32, point));
            }
        }
    };
    look(home, &mut best);
    let mut at = best?.1;
    loop {
        mesh.faces[at as usize].iter().for_each(|v| look(*v, &mut best));
        let now = best?.1;
        if now == at {
            return best.map(|(_, face, point)| (face, point));
        }
        at = now;
    }
}

/// For each wedge the least one that faces join it to.
fn islands(faces: &[[u32; 3]], count: usize) -> Vec<u32> {
    let mut of: Vec<u32> = (0..count as u32).collect();
    fn root(of: &mut [u32], mut v: u32) -> u32 {
        while of[v as usize] != v {
            of[v as usize] = of[of[v as usize] as usize];
            v = of[v as usize];
        }
        v
    }
    for [a, b, c] in faces {
        for other in [b, c] {
            let (x, y) = (root(&mut of, *a), root(&mut of, *other));
            let (low, high) = (x.min(y), x.max(y));
            of[high as usize] = low;
        }
    }
    (0..count as u32).map(|v| root(&mut of, v)).collect()
}
