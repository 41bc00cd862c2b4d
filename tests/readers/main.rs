//! The readers through their public face: every variant of the formats, lying and broken files, oracles, mutations.

#![allow(missing_docs)]

mod compressed;
mod gltf;
mod gltf_files;
mod mutate;
mod oracle;
mod ply;
mod stl;
mod text;
mod write;

use meshmill::error::{Error, Result};
use meshmill::mesh::coat::NOTHING;
use meshmill::progress::Progress;
use meshmill::read::{Crew, Layout, Scan};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// A file that lives as long as this.
pub struct Scratch {
    folder: tempfile::TempDir,
    name: &'static str,
}

impl Scratch {
    pub fn new(name: &'static str) -> Self {
        Scratch { folder: tempfile::tempdir().unwrap(), name }
    }

    pub fn path(&self) -> PathBuf {
        self.folder.path().join(self.name)
    }

    pub fn holding(name: &'static str, bytes: &[u8]) -> Self {
        let scratch = Scratch::new(name);
        scratch.put(bytes);
        scratch
    }

    /// Opens it as what may have to be unpacked.
    pub fn open_in(&self) -> Result<Scan> {
        self.open_within(1 << 20)
    }

    /// The same with a quota.
    pub fn open_within(&self, quota: u64) -> Result<Scan> {
        let scratch = meshmill::scratch::Scratch::in_folder(self.folder.path()).with_quota(quota).with_memory(1 << 24);
        Scan::open_in(&self.path(), &scratch, &Progress::default())
    }

    pub fn put(&self, bytes: &[u8]) {
        std::fs::write(self.path(), bytes).unwrap();
    }
}

/// Everything that streaming a scan yields, in the order of the file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Content {
    pub positions: Vec<[f64; 3]>,
    pub triangles: Vec<[u32; 3]>,
    pub soup: Vec<[[f64; 3]; 3]>,
}

/// Joins chunks, which must follow one another without a gap.
fn join<T: Clone>(mut chunks: Vec<(u64, Vec<T>)>) -> Vec<T> {
    chunks.sort_by_key(|chunk| chunk.0);
    let mut joined = Vec::new();
    for (first, chunk) in chunks {
        assert_eq!(first, joined.len() as u64, "a gap or overlap between chunks");
        assert!((1..=32_768).contains(&chunk.len()), "a chunk of {}", chunk.len());
        joined.extend(chunk);
    }
    joined
}

fn keep<T: Copy>(chunks: &Mutex<Vec<(u64, Vec<T>)>>, first: u64, chunk: &[T]) -> Result<()> {
    chunks.lock().unwrap().push((first, chunk.to_vec()));
    Ok(())
}

/// Streams a scan with so many workers, and checks what every scan promises.
pub fn stream(scan: &Scan, workers: usize) -> Result<Content> {
    let progress = Progress::default();
    let crew = Crew { workers, progress: &progress };
    let mut content = Content::default();
    if scan.layout() == Layout::Soup {
        let chunks = Mutex::new(Vec::new());
        scan.soup(&crew, || (), |(), c| keep(&chunks, c.first, c.triangles))?;
        content.soup = join(chunks.into_inner().unwrap());
        corners(scan, None)?;
        assert!(content.soup.as_flattened().as_flattened().iter().all(|x| x.is_finite()));
        assert_eq!(content.soup.len() as u64, scan.triangle_count());
        assert_eq!(scan.vertex_count(), 3 * scan.triangle_count());
        return Ok(content);
    }
    let chunks = Mutex::new(Vec::new());
    scan.vertices(&crew, || (), |(), c| keep(&chunks, c.first, c.positions))?;
    content.positions = join(chunks.into_inner().unwrap());
    let chunks = Mutex::new(Vec::new());
    scan.triangles(&crew, || (), |(), c| keep(&chunks, c.first, c.triangles))?;
    content.triangles = join(chunks.into_inner().unwrap());
    assert_eq!(content.positions.len() as u64, scan.vertex_count());
    assert_eq!(content.triangles.len() as u64, scan.triangle_count());
    assert!(content.triangles.as_flattened().iter().all(|v| u64::from(*v) < scan.vertex_count()));
    corners(scan, Some(&content.triangles))?;
    Ok(content)
}

/// Reads what corners and faces carry: of the same triangles, and of values that are there.
fn corners(scan: &Scan, triangles: Option<&[[u32; 3]]>) -> Result<()> {
    let progress = Progress::default();
    let Some(coat) = scan.coat(&progress)? else { return Ok(()) };
    let mut found = Vec::new();
    scan.corners(&coat, &progress, &mut |all| {
        assert!(all.uvs.iter().all(|i| *i == NOTHING || (*i as usize) < coat.uvs.len()));
        assert!(all.normals.iter().all(|i| *i == NOTHING || (*i as usize) < coat.normals.len()));
        assert!((all.patch as usize) < coat.patches.len());
        found.push(all.vertices);
    })?;
    assert_eq!(found.len() as u64, scan.triangle_count());
    assert!(triangles.is_none_or(|triangles| found == triangles));
    Ok(())
}

/// Opens and streams a file.
pub fn read(path: &Path) -> Result<(Scan, Content)> {
    let scan = Scan::open(path, &Progress::default())?;
    let content = stream(&scan, 2)?;
    Ok((scan, content))
}

/// What reading these bytes says, which must be one line that names the file.
pub fn complaint(name: &'static str, bytes: &[u8]) -> String {
    let file = Scratch::holding(name, bytes);
    match read(&file.path()) {
        Ok((scan, _)) => panic!("read as {} of {} triangles", scan.format(), scan.triangle_count()),
        Err(error) => told(&error, &file.path()),
    }
}

/// The text of an error without the path, which it must begin with.
pub fn told(error: &Error, path: &Path) -> String {
    let text = error.to_string();
    let text = text.strip_prefix(&format!("{}: ", path.display())).unwrap_or_else(|| panic!("no path: {text}"));
    assert!(!text.contains(char::is_control) && text.len() < 400, "{text:?}");
    assert_eq!(error.exit_code(), 1);
    text.to_string()
}

/// A small generator of repeatable numbers.
pub struct Random(pub u64);

impl Random {
    pub fn draw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub fn below(&mut self, n: usize) -> usize {
        (self.draw() % n as u64) as usize
    }

    pub fn pick<'a, T>(&mut self, from: &'a [T]) -> &'a T {
        &from[self.below(from.len())]
    }
}

/// The peak resident set of this process so far, in MiB.
pub fn peak_mib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with("VmHWM:")).unwrap_or("VmHWM: 0 kB");
    line.split_whitespace().nth(1).and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0) / 1024
}
