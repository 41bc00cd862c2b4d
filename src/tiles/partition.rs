//! A mesh cut into blocks: faces with the positions of their corners, so that any tile can be welded again.
//!
//! A vertex that faces of two tiles share must stay where it is while either is collapsed, or they would come apart. A
//! tile knows of some by itself: those that lie in another tile. The others, in a tile but used from outside, are its
//! *guests*: each face tells the cubes of its corners, such as no tile cuts, that it uses them.

use super::grid::{Blocks, Lie, cube, numbered, numbers, uncut};
use super::store::{Group, Store, Writer, find};
use crate::cores::InPieces;
use crate::error::Result;
use crate::facets::{Facet, Sink};
use crate::mesh::{BATCH, Coordinate, IndexedMesh, PositionTable, widen};
use crate::scratch::Scratch;
use glam::DVec3;
use rayon::prelude::*;
use std::cmp::Ordering;
use std::marker::PhantomData;

/// A mesh by blocks.
pub struct Partition<S> {
    blocks: Blocks,
    faces: Store,
    guests: Store,
    scalar: PhantomData<S>,
}

/// A mesh by tiles.
pub struct Tiles<'a, S> {
    partition: &'a Partition<S>,
    lie: Lie,
    /// All that hold a face, in order.
    pub places: Vec<Place>,
}

/// Where a tile's records are.
#[derive(Debug, Clone)]
pub struct Place {
    /// The tile.
    pub number: u64,
    /// How many faces there are.
    pub count: u64,
    faces: Group,
    guests: Group,
}

/// A tile in memory.
pub struct Tile<S> {
    /// Its faces, welded.
    pub mesh: IndexedMesh<S>,
    /// Vertices that other tiles use, in order.
    pub locked: Vec<u32>,
    table: PositionTable,
}

impl<S: Coordinate> Tile<S> {
    /// The vertices at these positions, where there are any.
    pub fn find(&self, positions: &[[S; 3]], mut found: impl FnMut(usize, Option<u32>)) {
        for (batch, first) in positions.chunks(BATCH).zip((0..).step_by(BATCH)) {
            let looked_up = self.table.look_up(batch, &self.mesh.positions);
            for (i, (p, at)) in batch.iter().zip(looked_up).enumerate() {
                found(first + i, self.table.find(p, at, &self.mesh.positions));
            }
        }
    }
}

/// Bytes of a face while a tile is loaded: its corners, its place in the order, and what is welded of it.
pub const fn loading_bytes<S>() -> u64 {
    (3 * size_of::<[S; 3]>() + 16 + size_of::<[S; 3]>() / 2 + 9 + 12) as u64
}

impl<S: Coordinate> Partition<S> {
    /// An empty one, with so many bytes for each writer.
    pub fn new(blocks: Blocks, writer_bytes: u64, scratch: &Scratch) -> Result<Self> {
        let faces = Store::new(size_of::<[[S; 3]; 3]>(), writer_bytes / 8 * 7, scratch)?;
        let guests = Store::new(size_of::<[[S; 3]; 2]>(), writer_bytes / 8, scratch)?;
        Ok(Partition { blocks, faces, guests, scalar: PhantomData })
    }

    /// One of those who write side by side.
    pub fn writer(&self) -> Cutter<'_, S> {
        let (faces, guests) = (self.faces.writer(), self.guests.writer());
        Cutter { blocks: self.blocks, faces, guests, failed: Ok(()), area: 0, scalar: PhantomData }
    }

    /// Cuts up a whole mesh.
    pub fn add(&self, mesh: &IndexedMesh<S>) -> Result<Cut> {
        let mut cutter = self.writer();
        for face in &mesh.faces {
            cutter.push(face.map(|v| mesh.positions[v as usize]))?;
        }
        cutter.finish()
    }

    /// The tiles of a sweep.
    pub fn tiles(&mut self, lie: Lie) -> Tiles<'_, S> {
        let guests = self.guests.groups(|block| lie.tile(block));
        let faces = self.faces.groups(|block| lie.tile(block));
        let place = |(number, faces)| {
            let count = self.faces.records(&faces) as u64;
            Place { number, count, faces, guests: find(&guests, number) }
        };
        let places = faces.into_iter().map(place).collect();
        Tiles { partition: self, lie, places }
    }

    /// Cubes of so many blocks along a side that hold a face: the number of each, in order, and where its faces are until
    /// the mesh is looked at in another way. Of small blocks there are only cubes of 4.
    pub fn cubes(&mut self, side: u32) -> Vec<(u64, Group)> {
        self.faces.groups(|block| cube(block, side))
    }

    /// Some faces, in whatever order they were written.
    pub fn soup(&self, faces: &Group) -> Result<Vec<[[S; 3]; 3]>> {
        let mut soup: Vec<[[S; 3]; 3]> = bytemuck::zeroed_vec(self.faces.records(faces));
        self.faces.read(faces, bytemuck::cast_slice_mut(&mut soup))?;
        Ok(soup)
    }
}

impl<S: Coordinate> Tiles<'_, S> {
    /// Loads a tile.
    pub fn load(&self, place: &Place) -> Result<Tile<S>> {
        let Tiles { partition: Partition { blocks, guests, .. }, lie, .. } = self;
        let (mesh, table) = welded(self.partition.soup(&place.faces)?, blocks);
        let mut loaded = Tile { mesh, locked: Vec::new(), table };
        let outside = |p: &[S; 3]| lie.tile(blocks.of(widen(*p))) != place.number;
        let positions = &loaded.mesh.positions;
        let mut locked: Vec<u32> = (0..positions.len() as u32).filter(|v| outside(&positions[*v as usize])).collect();
        let mut used = Vec::new();
        guests.each(&place.guests, |record| {
            let [at, from]: [[S; 3]; 2] = bytemuck::pod_read_unaligned(record);
            if lie.tile(numbered(from)) != place.number {
                used.push(at);
            }
        })?;
        loaded.find(&used, |_, vertex| locked.extend(vertex));
        locked.sort_unstable();
        locked.dedup();
        loaded.locked = locked;
        Ok(loaded)
    }
}

/// One writer's end of a [`Partition`].
pub struct Cutter<'a, S> {
    blocks: Blocks,
    faces: Writer<'a>,
    guests: Writer<'a>,
    failed: Result<()>,
    area: u128,
    scalar: PhantomData<S>,
}

/// The unit that areas are summed in: whole numbers, so that their order does not matter.
const AREA_UNIT: f64 = 1.0 / (1u128 << 80) as f64;

/// What was cut up.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cut {
    /// Faces.
    pub faces: u64,
    area: u128,
}

impl Cut {
    /// All together.
    pub fn sum(parts: impl IntoIterator<Item = Cut>) -> Cut {
        let add = |sum: Cut, part: Cut| Cut { faces: sum.faces + part.faces, area: sum.area + part.area };
        parts.into_iter().fold(Cut::default(), add)
    }

    /// Their area, in the frame.
    pub fn area(&self) -> f64 {
        self.area as f64 * AREA_UNIT
    }
}

impl<S: Coordinate> Cutter<'_, S> {
    /// Adds a face.
    #[inline]
    pub fn push(&mut self, face: [[S; 3]; 3]) -> Result<()> {
        let corners: [DVec3; 3] = face.map(widen);
        let block = self.blocks.of_face(corners);
        let [a, b, c] = corners;
        self.area += (0.5 * (b - a).cross(c - a).length() / AREA_UNIT) as u128;
        self.faces.push(self.blocks.put_away(block), &[bytemuck::bytes_of(&face)])?;
        let here = uncut(block);
        for (corner, p) in corners.iter().zip(&face) {
            let own = uncut(self.blocks.of(*corner));
            if own != here {
                self.guests.push(own, &[bytemuck::bytes_of(p), bytemuck::bytes_of(&numbers::<S>(here))])?;
            }
        }
        Ok(())
    }

    /// Writes what is held back.
    pub fn finish(mut self) -> Result<Cut> {
        self.failed?;
        self.faces.flush()?;
        self.guests.flush()?;
        Ok(Cut { faces: self.faces.written, area: self.area })
    }
}

impl<S: Coordinate> Sink for Cutter<'_, S> {
    fn take(&mut self, faces: &[Facet]) {
        for facet in faces {
            if self.failed.is_ok() {
                self.failed = self.push(facet.corners.map(|p| p.to_array().map(S::narrow)));
            }
        }
    }
}

/// Welds a soup; its faces come out along a curve through space, whatever their order was.
pub(crate) fn welded<S: Coordinate>(soup: Vec<[[S; 3]; 3]>, blocks: &Blocks) -> (IndexedMesh<S>, PositionTable) {
    let order = in_order(&soup, blocks);
    let mut mesh = IndexedMesh { positions: Vec::with_capacity(soup.len() / 2 + 64), faces: Vec::new() };
    let mut table = PositionTable::with_room_for(soup.len() / 2 + 64);
    let mut faces = Vec::with_capacity(soup.len());
    for some in order.chunks(BATCH / 3) {
        let mut batch = [[S::narrow(0.0); 3]; BATCH];
        let batch = &mut batch[..3 * some.len()];
        for (corners, (_, i)) in batch.as_chunks_mut::<3>().0.iter_mut().zip(some) {
            *corners = soup[*i as usize];
        }
        if !table.has_room_for(mesh.positions.len() + batch.len()) {
            table.grow(&mesh.positions);
        }
        let looked_up = table.look_up(batch, &mesh.positions);
        for (corners, looked_up) in batch.as_chunks::<3>().0.iter().zip(looked_up.as_chunks::<3>().0) {
            let mut face = [0; 3];
            for ((v, p), at) in face.iter_mut().zip(corners).zip(looked_up) {
                let new = mesh.positions.len() as u32;
                *v = table.find_or_insert(p, *at, &mesh.positions, new);
                if *v == new {
                    mesh.positions.push(*p);
                }
            }
            if face[0] != face[1] && face[1] != face[2] && face[2] != face[0] {
                faces.push(face);
            }
        }
    }
    mesh.faces = faces;
    (mesh, table)
}

/// The order of faces: by the place of their first corner along a Morton curve, then by all that they are.
fn in_order<S: Coordinate>(soup: &[[[S; 3]; 3]], blocks: &Blocks) -> Vec<(u64, u32)> {
    let key = |(i, face): (usize, &[[S; 3]; 3])| (blocks.along_curve(widen(face[0])), i as u32);
    let mut order: Vec<(u64, u32)> = soup.par_iter().enumerate().in_pieces(4096).map(key).collect();
    let by_place = |a: &(u64, u32), b: &(u64, u32)| {
        a.0.cmp(&b.0).then_with(|| by_corners(&soup[a.1 as usize], &soup[b.1 as usize])).then(a.1.cmp(&b.1))
    };
    order.par_sort_unstable_by(by_place);
    order
}

fn by_corners<S: Coordinate>(a: &[[S; 3]; 3], b: &[[S; 3]; 3]) -> Ordering {
    let numbers = a.as_flattened().iter().zip(b.as_flattened());
    numbers.map(|(x, y)| x.widen().total_cmp(&y.widen())).find(|order| order.is_ne()).unwrap_or(Ordering::Equal)
}

#[cfg(test)]
mod tests {
    use super::super::grid;
    use super::*;
    use crate::mesh::{Extent, Frame};
    use crate::progress::Progress;
    use crate::read::Scan;
    use std::collections::BTreeMap;

    /// A square of n × n × 2 faces in the plane, from 0 to 1.
    fn square(n: u32) -> IndexedMesh<f32> {
        let at = |i: u32| i as f32 / n as f32;
        let positions = (0..=n).flat_map(|y| (0..=n).map(move |x| [at(x), at(y), 0.0])).collect();
        let number = |x: u32, y: u32| y * (n + 1) + x;
        let quad = |x: u32, y: u32| {
            let [a, b, c, d] = [number(x, y), number(x + 1, y), number(x + 1, y + 1), number(x, y + 1)];
            [[a, b, c], [a, c, d]]
        };
        IndexedMesh { positions, faces: (0..n).flat_map(|y| (0..n).flat_map(move |x| quad(x, y))).collect() }
    }

    fn blocks(folder: &std::path::Path, most: u64) -> Blocks {
        let path = folder.join("square.stl");
        let progress = Progress::default();
        let target = crate::write::Target::prepare(&path, None).unwrap();
        target.write_mesh(&square(64), Frame::default(), &progress).unwrap();
        let scan = Scan::open(&path, &progress).unwrap();
        let crew = crate::read::Crew { workers: 2, progress: &progress };
        let extent = scan.extent(&crew).unwrap();
        assert_eq!(extent, Extent { min: DVec3::ZERO, max: DVec3::new(1.0, 1.0, 0.0) });
        grid::blocks(&scan, &crew, (Frame::default(), &extent), most).unwrap().unwrap()
    }

    #[test]
    fn tiles_hold_every_face_once_and_lock_what_they_share() {
        let folder = tempfile::tempdir().unwrap();
        let blocks = blocks(folder.path(), 1500);
        for (faces, are_small) in [(0, true), (u64::MAX, false)] {
            let blocks = blocks.of_faces(faces, 1);
            assert_eq!(blocks.are_small(), are_small);
            every_face_once(blocks, folder.path());
        }
    }

    fn every_face_once(blocks: Blocks, folder: &std::path::Path) {
        let mut partition = Partition::<f32>::new(blocks, 1 << 12, &Scratch::in_folder(folder)).unwrap();
        let mut mesh = square(64);
        let cut = partition.add(&mesh).unwrap();
        assert!(cut.faces == 8192 && (cut.area() - 1.0).abs() < 1e-12, "{cut:?}");
        for lie in [Lie::Straight, Lie::Shifted] {
            let tiles = partition.tiles(lie);
            assert!(tiles.places.len() > 5);
            let mut users: BTreeMap<[u32; 3], u32> = BTreeMap::new();
            let mut locked = BTreeMap::new();
            let mut faces = 0;
            for place in &tiles.places {
                let loaded = tiles.load(place).unwrap();
                assert_eq!(loaded.mesh.faces.len() as u64, place.count);
                assert!(place.count <= 1500);
                faces += place.count;
                for (v, position) in loaded.mesh.positions.iter().enumerate() {
                    let key = position.map(f32::to_bits);
                    *users.entry(key).or_default() += 1;
                    *locked.entry(key).or_insert(0) += u32::from(loaded.locked.binary_search(&(v as u32)).is_ok());
                }
            }
            assert_eq!((faces, users.len()), (8192, mesh.positions.len()));
            for (key, users) in &users {
                let locks = locked[key];
                assert!(locks == *users || *users == 1 && locks <= 1, "{users} tiles, locked in {locks}");
            }
        }
        // Whatever the order in which faces came.
        let mut again = Partition::<f32>::new(blocks, 1 << 9, &Scratch::in_folder(folder)).unwrap();
        mesh.faces.reverse();
        again.add(&mesh).unwrap();
        let load = |partition: &mut Partition<f32>| {
            let tiles = partition.tiles(Lie::Straight);
            tiles.load(&tiles.places[0]).unwrap().mesh
        };
        assert_eq!(load(&mut partition), load(&mut again));
    }
}
