//! A scan that is too large to hold.

use super::edges::{Edges, Gatherer, MOST_PARTS, Name, Odd, gatherer_bytes};
use super::{Findings, Unsaid, held_bytes};
use crate::error::Result;
use crate::mesh::Extent;
use crate::mesh::audit::Pieces;
use crate::read::{Crew, Layout, Scan};
use crate::scratch::Scratch;
use glam::DVec3;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

pub(super) fn findings(scan: &Scan, crew: &Crew<'_>, scratch: &Scratch, array_bytes: u64) -> Result<Findings> {
    let mut found = match scan.layout() {
        Layout::Indexed => indexed(scan, crew, scratch, array_bytes)?,
        Layout::Soup => soup(scan, crew, scratch, array_bytes)?,
    };
    let whole = Some(held_bytes(scan));
    let mut unsay = |said: bool, what| {
        if !said && !found.unsaid.iter().any(|unsaid| unsaid.what == what) {
            found.unsaid.push(Unsaid { what, needed_bytes: whole });
        }
    };
    unsay(found.unreferenced_vertices.is_some(), "unreferenced vertices");
    unsay(found.duplicate_vertices.is_some(), "vertices at one place");
    unsay(found.flat_faces.is_some(), "faces without area");
    unsay(found.components.is_some(), "components");
    unsay(found.border_edges.is_some(), "border edges");
    unsay(found.nonmanifold_edges.is_some(), "non-manifold edges");
    unsay(found.borders.is_some(), "borders");
    unsay(found.nonmanifold_vertices.is_some(), "non-manifold vertices");
    Ok(found)
}

fn indexed(scan: &Scan, crew: &Crew<'_>, scratch: &Scratch, array_bytes: u64) -> Result<Findings> {
    let extent = scan.extent(crew)?;

    // What may be had, the cheaper first; half is for the edges.
    let (vertices, mut left) = (scan.vertex_count(), array_bytes / 2);
    let mut afford = |bytes: u64| {
        let fits = bytes <= left;
        left -= if fits { bytes } else { 0 };
        fits
    };
    let bits: Option<Vec<AtomicU64>> =
        afford(vertices.div_ceil(64) * 8).then(|| bytemuck::zeroed_vec(vertices.div_ceil(64) as usize));
    let pieces = (vertices < 1 << 32 && afford(4 * vertices)).then(|| Mutex::new(Pieces::of(vertices as usize)));

    let (parts, workers) = share::<u32>(scan, crew, array_bytes / 2);
    let crew = Crew { workers, ..*crew };
    let edges = Edges::<u32>::new(scratch, parts)?;
    let passed = scan.triangles(
        &crew,
        || Worker::of(&edges),
        |mine, chunk| {
            for &[a, b, c] in chunk.triangles {
                if a == b || b == c || c == a {
                    mine.repeated += 1;
                    continue;
                }
                edges.take(&mut mine.gathered, [a, b, c])?;
            }
            let whole = chunk.triangles.iter().filter(|[a, b, c]| a != b && b != c && c != a);
            if let Some(bits) = &bits {
                for v in whole.clone().flatten() {
                    let (word, bit) = (&bits[*v as usize / 64], 1 << (v % 64));
                    if word.load(Relaxed) & bit == 0 {
                        word.fetch_or(bit, Relaxed);
                    }
                }
            }
            if let Some(pieces) = &pieces {
                let mut pieces = pieces.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                for [a, b, c] in whole {
                    pieces.join(*a, *b);
                    pieces.join(*a, *c);
                }
            }
            Ok(())
        },
    )?;
    let repeated_corner_faces = passed.iter().map(|worker| worker.repeated).sum();
    passed.into_iter().try_for_each(|worker| edges.finish(worker.gathered))?;
    let used = bits.map(|bits| bits.iter().map(|word| u64::from(word.load(Relaxed).count_ones())).sum::<u64>());
    let sets = pieces.map(|p| p.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner).count());
    let Odd { border, nonmanifold } = edges.count(crew.progress)?;
    let unreferenced = used.map(|used| vertices - used);
    let mut unsaid = Vec::new();
    if sets.is_none() && vertices < 1 << 32 {
        // Half of it for the edges.
        unsaid.push(Unsaid { what: "components", needed_bytes: Some(2 * (4 * vertices + vertices.div_ceil(64) * 8)) });
    }
    Ok(Findings {
        extent,
        unreferenced_vertices: unreferenced,
        repeated_corner_faces,
        // A vertex that no face uses is a set of its own.
        components: sets.zip(unreferenced).map(|(sets, alone)| sets - alone),
        border_edges: Some(border),
        nonmanifold_edges: Some(nonmanifold),
        unsaid,
        ..Findings::default()
    })
}

fn soup(scan: &Scan, crew: &Crew<'_>, scratch: &Scratch, array_bytes: u64) -> Result<Findings> {
    let (parts, workers) = share::<u64>(scan, crew, array_bytes);
    let crew = Crew { workers, ..*crew };
    let edges = Edges::<u64>::new(scratch, parts)?;
    let passed = scan.soup(
        &crew,
        || Worker::of(&edges),
        |mine, chunk| {
            for corners in chunk.triangles {
                let [a, b, c] = corners.map(DVec3::from_array);
                mine.extent.include(a);
                mine.extent.include(b);
                mine.extent.include(c);
                if a == b || b == c || c == a {
                    mine.repeated += 1;
                    continue;
                }
                mine.flat += u64::from((b - a).cross(c - a) == DVec3::ZERO);
                edges.take(&mut mine.gathered, corners.map(hash))?;
            }
            Ok(())
        },
    )?;
    let extent = passed.iter().fold(Extent::default(), |extent, worker| extent.union(worker.extent));
    let repeated_corner_faces = passed.iter().map(|worker| worker.repeated).sum();
    let flat = passed.iter().map(|worker| worker.flat).sum();
    passed.into_iter().try_for_each(|worker| edges.finish(worker.gathered))?;
    let Odd { border, nonmanifold } = edges.count(crew.progress)?;
    Ok(Findings {
        welded: true,
        extent,
        duplicate_vertices: Some(0),
        unreferenced_vertices: Some(0),
        repeated_corner_faces,
        flat_faces: Some(flat),
        border_edges: Some(border),
        nonmanifold_edges: Some(nonmanifold),
        ..Findings::default()
    })
}

/// What a worker of a pass has seen.
struct Worker<N> {
    gathered: Gatherer<N>,
    extent: Extent,
    repeated: u64,
    flat: u64,
}

impl<N: Name> Worker<N> {
    fn of(edges: &Edges<N>) -> Self {
        Worker { gathered: edges.gatherer(), extent: Extent::default(), repeated: 0, flat: 0 }
    }
}

/// Parts of the edges, each of which is to fit half of `bytes`, and workers whose gatherers fit the other half. Parts are
/// about even: a third more than the average is the most that is expected of one.
fn share<N>(scan: &Scan, crew: &Crew<'_>, bytes: u64) -> (usize, usize) {
    let all = u128::from(scan.triangle_count()) * 3 * size_of::<[N; 2]>() as u128;
    let parts = (all * 8 / 3).div_ceil(u128::from(bytes.max(1))).clamp(1, MOST_PARTS as u128) as usize;
    let workers = (bytes / 2 / gatherer_bytes::<N>(parts)).clamp(1, crew.workers as u64) as usize;
    (parts, workers)
}

/// 64 well mixed bits of a place; −0 is 0.
fn hash(corner: [f64; 3]) -> u64 {
    corner.iter().fold(0, |h: u64, x| {
        let h = (h ^ (x + 0.0).to_bits()).wrapping_add(0x9e37_79b9_7f4a_7c15);
        let h = (h ^ (h >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
        let h = (h ^ (h >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
        h ^ (h >> 32)
    })
}
