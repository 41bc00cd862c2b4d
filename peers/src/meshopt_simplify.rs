//! meshoptimizer's simplifier with update (`meshopt_simplifyWithUpdate`): PLY in, PLY out, one line of JSON.

mod ply;

use clap::Parser;
use meshopt::{SimplifyOptions, VertexDataAdapter};
use ply::Mesh;
use std::io::{Error, Result};
use std::path::PathBuf;
use std::time::Instant;

/// Reduces a binary little-endian PLY with meshoptimizer's simplifier with update.
#[derive(Parser)]
struct Args {
    /// Float positions and triangles, nothing else.
    input: PathBuf,
    output: PathBuf,
    /// Faces to end with.
    #[arg(long)]
    faces: usize,
    /// First reduce to RATIO times the faces with the sloppy simplifier (which clusters vertices).
    #[arg(long, value_name = "RATIO")]
    sloppy_first: Option<f64>,
}

#[derive(serde::Serialize)]
struct Report {
    in_faces: usize,
    /// Between the sloppy simplifier and the other.
    #[serde(skip_serializing_if = "Option::is_none")]
    sloppy_faces: Option<usize>,
    /// What the sloppy simplifier took of `algo_s`.
    #[serde(skip_serializing_if = "Option::is_none")]
    sloppy_s: Option<f64>,
    out_faces: usize,
    read_s: f64,
    algo_s: f64,
    write_s: f64,
    total_s: f64,
    cpu_s: f64,
    peak_rss_bytes: Option<u64>,
}

/// Relative to the extent: no limit at all, the count alone decides.
const ANY_ERROR: f32 = 1.0;

fn main() -> Result<()> {
    let args = Args::parse();
    let begun = Instant::now();
    let mut mesh = ply::read(&args.input)?;
    let in_faces = mesh.indices.len() / 3;
    let read = Instant::now();

    let sloppy_faces = args.sloppy_first.map(|ratio| (ratio * args.faces as f64) as usize);
    if let Some(faces) = sloppy_faces {
        mesh.indices = sloppy(&mesh, faces)?;
    }
    let sloppy = sloppy_faces.map(|_| (mesh.indices.len() / 3, read.elapsed().as_secs_f64()));
    let left = meshopt::simplify_with_update(
        &mut mesh.indices,
        &mut mesh.positions,
        &mut [],
        &[],
        0,
        None,
        3 * args.faces,
        ANY_ERROR,
        SimplifyOptions::None,
        None,
    );
    mesh.indices.truncate(left);
    let simplified = Instant::now();

    drop_unused(&mut mesh);
    ply::write(&args.output, &mesh)?;
    let report = Report {
        in_faces,
        sloppy_faces: sloppy.map(|(faces, _)| faces),
        sloppy_s: sloppy.map(|(_, seconds)| seconds),
        out_faces: mesh.indices.len() / 3,
        read_s: (read - begun).as_secs_f64(),
        algo_s: (simplified - read).as_secs_f64(),
        write_s: simplified.elapsed().as_secs_f64(),
        total_s: begun.elapsed().as_secs_f64(),
        cpu_s: cpu_seconds()?,
        peak_rss_bytes: peak_rss_bytes(),
    };
    println!("{}", serde_json::to_string(&report)?);
    Ok(())
}

fn sloppy(mesh: &Mesh, faces: usize) -> Result<Vec<u32>> {
    let positions = VertexDataAdapter::new(bytemuck::cast_slice(&mesh.positions), size_of::<[f32; 3]>(), 0)
        .map_err(Error::other)?;
    Ok(meshopt::simplify_sloppy(&mesh.indices, &positions, 3 * faces, ANY_ERROR, None))
}

/// Drops vertices that no face uses, in place, keeping their order.
fn drop_unused(mesh: &mut Mesh) {
    let mut renumbered = vec![u32::MAX; mesh.positions.len()];
    for &v in &mesh.indices {
        renumbered[v as usize] = 0;
    }
    let mut kept = 0;
    for (v, number) in renumbered.iter_mut().enumerate().filter(|(_, n)| **n == 0) {
        mesh.positions[kept] = mesh.positions[v];
        *number = kept as u32;
        kept += 1;
    }
    mesh.positions.truncate(kept);
    for v in &mut mesh.indices {
        *v = renumbered[*v as usize];
    }
}

/// User and system time of this process.
fn cpu_seconds() -> Result<f64> {
    // SAFETY: all bytes zero are a `rusage`, and `getrusage` writes to nothing but the one it is given.
    let usage = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        if libc::getrusage(libc::RUSAGE_SELF, &mut usage) != 0 {
            return Err(Error::last_os_error());
        }
        usage
    };
    let seconds = |t: libc::timeval| t.tv_sec as f64 + t.tv_usec as f64 * 1e-6;
    Ok(seconds(usage.ru_utime) + seconds(usage.ru_stime))
}

/// `VmHWM`: what `getrusage` calls `ru_maxrss` begins with the parent's.
fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    Some(1024 * line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?)
}
