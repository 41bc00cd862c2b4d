//! Meshes drawn on plates: in memory, or streamed past.

use super::plate::{Paint, Plate};
use crate::cores::InPieces;
use crate::error::Result;
use crate::mesh::{Coordinate, Frame, IndexedMesh};
use crate::read::{Crew, Layout, Scan};
use glam::Vec3;
use rayon::prelude::*;

const POSITION: u64 = size_of::<Vec3>() as u64;

/// What drawing a scan holds beside the plates: the positions of an indexed one.
pub fn held_bytes(scan: &Scan) -> u64 {
    match scan.layout() {
        Layout::Indexed => scan.vertex_count().saturating_mul(POSITION),
        Layout::Soup => 0,
    }
}

/// Draws a scan on plates that look in the same direction, holding at most so many bytes.
pub fn draw_scan(scan: &Scan, plates: &[Plate], crew: &Crew, bytes: u64) -> Result<()> {
    let Some(first) = plates.first() else { return Ok(()) };
    match scan.layout() {
        Layout::Soup => {
            let camera = *first.camera();
            scan.soup(
                crew,
                || (),
                |(), chunk| {
                    for [a, b, c] in chunk.triangles {
                        let corners = [camera.view((*a).into()), camera.view((*b).into()), camera.view((*c).into())];
                        expose(plates, corners, Paint::Plain);
                    }
                    Ok(())
                },
            )?;
        }
        Layout::Indexed if held_bytes(scan) <= bytes => draw_held(scan, plates, crew)?,
        Layout::Indexed => {
            for plate in plates {
                let near = Near::of(scan, plate, crew, bytes)?;
                match near {
                    Some(near) => near.draw(scan, plate, crew)?,
                    None => draw_dots(scan, plate, crew)?,
                }
            }
        }
    }
    Ok(())
}

/// Draws the triangles of a scan whose positions can all be held.
fn draw_held(scan: &Scan, plates: &[Plate], crew: &Crew) -> Result<()> {
    let camera = *plates[0].camera();
    let one = Crew { workers: 1, ..*crew };
    let positions = scan.vertices(
        &one,
        || Vec::with_capacity(scan.vertex_count() as usize),
        |held: &mut Vec<Vec3>, chunk| {
            held.extend(chunk.positions.iter().map(|p| camera.view((*p).into())));
            Ok(())
        },
    )?;
    let positions = positions.into_iter().next().unwrap_or_default();
    let at = |v: u32| positions[v as usize];
    scan.triangles(
        crew,
        || (),
        |(), chunk| {
            for &[a, b, c] in chunk.triangles {
                expose(plates, [at(a), at(b), at(c)], Paint::Plain);
            }
            Ok(())
        },
    )?;
    Ok(())
}

/// Draws a scan of more vertices than can be held.
fn draw_dots(scan: &Scan, plate: &Plate, crew: &Crew) -> Result<()> {
    let camera = *plate.camera();
    scan.vertices(
        crew,
        || (),
        |(), chunk| {
            chunk.positions.iter().for_each(|p| plate.dot(camera.view((*p).into())));
            Ok(())
        },
    )?;
    Ok(())
}

/// The positions of the vertices in and around a picture that is zoomed in, found by their numbers: a bit a vertex says
/// whether it is there, and how many are before it where.
struct Near {
    bits: Vec<u64>,
    before: Vec<u32>,
    positions: Vec<Vec3>,
}

impl Near {
    /// `None` where the picture shows more than fits.
    fn of(scan: &Scan, plate: &Plate, crew: &Crew, bytes: u64) -> Result<Option<Near>> {
        let words = scan.vertex_count().div_ceil(64);
        let Some(most) = bytes.checked_sub(12 * words).map(|left| (left / POSITION) as usize) else { return Ok(None) };
        let camera = *plate.camera();
        let mut near = Near { bits: vec![0; words as usize], before: Vec::new(), positions: Vec::new() };
        let one = Crew { workers: 1, ..*crew };
        let found = scan.vertices(
            &one,
            || (Vec::<u32>::new(), Vec::<Vec3>::new()),
            |(numbers, positions), chunk| {
                for (i, p) in chunk.positions.iter().enumerate() {
                    let p = camera.view((*p).into());
                    // Growing by doubling, and the number beside the position, take more than twice what is kept.
                    if plate.is_around(p) && positions.len() < most / 3 {
                        numbers.push((chunk.first + i as u64) as u32);
                        positions.push(p);
                    }
                }
                Ok(())
            },
        )?;
        let (numbers, positions) = found.into_iter().next().unwrap_or_default();
        if positions.len() >= most / 3 {
            return Ok(None);
        }
        numbers.iter().for_each(|&v| near.bits[v as usize / 64] |= 1 << (v % 64));
        let mut count = 0;
        near.before.extend(near.bits.iter().map(|word| {
            count += word.count_ones();
            count - word.count_ones()
        }));
        near.positions = positions;
        Ok(Some(near))
    }

    fn at(&self, v: u32) -> Option<Vec3> {
        let (word, bit) = (v as usize / 64, 1u64 << (v % 64));
        let below = (self.bits[word] & (bit - 1)).count_ones();
        (self.bits[word] & bit != 0).then(|| self.positions[(self.before[word] + below) as usize])
    }

    fn draw(&self, scan: &Scan, plate: &Plate, crew: &Crew) -> Result<()> {
        scan.triangles(
            crew,
            || (),
            |(), chunk| {
                for &[a, b, c] in chunk.triangles {
                    if let (Some(a), Some(b), Some(c)) = (self.at(a), self.at(b), self.at(c)) {
                        plate.triangle([a, b, c], Paint::Plain);
                    }
                }
                Ok(())
            },
        )?;
        Ok(())
    }
}

/// Draws a mesh that is in memory, with a colour for each vertex or without.
pub fn draw_mesh<S: Coordinate>(
    mesh: &IndexedMesh<S>,
    frame: Frame,
    plates: &[Plate],
    colour: Option<&(dyn Fn(u32) -> [u8; 3] + Sync)>,
) {
    let Some(first) = plates.first() else { return };
    let seen = |v: u32| first.camera().view(frame.place_back(mesh.at(v)));
    mesh.faces.par_iter().in_pieces(4096).for_each(|face| {
        let corners = face.map(seen);
        match colour {
            Some(colour) => expose(plates, corners, Paint::Corners(&face.map(colour))),
            None => expose(plates, corners, Paint::Plain),
        }
    });
}

/// Corners are as the first plate's camera sees them.
#[inline(always)]
fn expose(plates: &[Plate], corners: [Vec3; 3], paint: Paint) {
    let [a, b, c] = corners;
    plates[0].triangle(corners, paint);
    for plate in &plates[1..] {
        let shift = plates[0].camera().shift_to(plate.camera());
        plate.triangle([a + shift, b + shift, c + shift], paint);
    }
}
