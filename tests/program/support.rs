//! Meshes of known shape, files of them, and the program run on those.

use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

/// A mesh in doubles, whatever it is stored in.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    pub positions: Vec<[f64; 3]>,
    pub faces: Vec<[u32; 3]>,
}

/// How a mesh becomes a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Floats,
    Doubles,
    Text,
    Stl,
}

impl Kind {
    pub fn extension(self) -> &'static str {
        if self == Kind::Stl { "stl" } else { "ply" }
    }
}

/// A torus with ripples: closed, manifold, `2 * around * across` faces in a coherent order.
pub fn torus(around: u32, across: u32) -> Mesh {
    let position = |i: u32, j: u32| {
        let (u, v) = (turn(i, around), turn(j, across));
        let r = 0.4 + 0.01 * (7.0 * u).sin() * (5.0 * v).cos() + 0.002 * (61.0 * u).cos() * (23.0 * v).sin();
        [(1.0 + r * v.cos()) * u.cos(), (1.0 + r * v.cos()) * u.sin(), r * v.sin()].map(as_float)
    };
    let positions = (0..around).flat_map(|i| (0..across).map(move |j| position(i, j))).collect();
    let number = |i: u32, j: u32| (i % around) * across + j % across;
    let faces = (0..around).flat_map(|i| (0..across).flat_map(move |j| quad(i, j, number))).collect();
    Mesh { positions, faces }
}

/// Hills over the rectangle from (0, 0) to (columns, rows): open, `2 * columns * rows` faces. All of the rim has height 0.
pub fn field(columns: u32, rows: u32) -> Mesh {
    let wide = columns + 1;
    let position = |i: u32, j: u32| {
        let (x, y) = (f64::from(i) / f64::from(columns), f64::from(j) / f64::from(rows));
        let rim = 16.0 * x * (1.0 - x) * y * (1.0 - y);
        let hills = 0.05 * (21.0 * x).sin() * (17.0 * y).cos() + 0.004 * (140.0 * x).sin() * (160.0 * y).sin();
        [f64::from(i), f64::from(j), as_float(f64::from(columns) * rim * (0.1 + hills))]
    };
    let positions = (0..=rows).flat_map(|j| (0..wide).map(move |i| position(i, j))).collect();
    let number = |i: u32, j: u32| j * wide + i;
    let faces = (0..rows).flat_map(|j| (0..columns).flat_map(move |i| quad(i, j, number))).collect();
    Mesh { positions, faces }
}

fn quad(i: u32, j: u32, number: impl Fn(u32, u32) -> u32) -> [[u32; 3]; 2] {
    let [a, b, c, d] = [number(i, j), number(i + 1, j), number(i + 1, j + 1), number(i, j + 1)];
    [[a, b, c], [a, c, d]]
}

fn turn(i: u32, of: u32) -> f64 {
    std::f64::consts::TAU * f64::from(i) / f64::from(of)
}

/// The nearest number that a float holds.
pub fn as_float(x: f64) -> f64 {
    f64::from(x as f32)
}

/// Numbers that look random and are the same every time.
pub struct Dice(u64);

impl Dice {
    pub fn new(seed: u64) -> Self {
        Dice(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    pub fn below(&mut self, n: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) % n
    }

    /// In `0..1`.
    pub fn unit(&mut self) -> f64 {
        self.below(1 << 40) as f64 / (1u64 << 40) as f64
    }

    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, self.below(i as u64 + 1) as usize);
        }
    }
}

impl Mesh {
    /// The same faces in another order, each begun at another corner.
    pub fn with_shuffled_faces(mut self) -> Mesh {
        let mut dice = Dice::new(3);
        dice.shuffle(&mut self.faces);
        self.faces.iter_mut().for_each(|face| face.rotate_left(dice.below(3) as usize));
        self
    }

    /// The same mesh under other vertex numbers.
    pub fn with_shuffled_vertices(self) -> Mesh {
        let mut order: Vec<u32> = (0..self.positions.len() as u32).collect();
        Dice::new(5).shuffle(&mut order);
        let mut positions = vec![[0.0; 3]; order.len()];
        for (old, &new) in order.iter().enumerate() {
            positions[new as usize] = self.positions[old];
        }
        Mesh { positions, faces: self.faces.iter().map(|face| face.map(|v| order[v as usize])).collect() }
    }

    pub fn map(mut self, f: impl Fn([f64; 3]) -> [f64; 3]) -> Mesh {
        self.positions.iter_mut().for_each(|p| *p = f(*p));
        self
    }

    pub fn scaled(self, by: f64) -> Mesh {
        self.map(|p| p.map(|x| x * by))
    }

    /// Both side by side, without a common vertex.
    pub fn and(mut self, other: Mesh) -> Mesh {
        let offset = self.positions.len() as u32;
        self.positions.extend(other.positions);
        self.faces.extend(other.faces.iter().map(|face| face.map(|v| v + offset)));
        self
    }

    pub fn bytes(&self, kind: Kind) -> Vec<u8> {
        match kind {
            Kind::Stl => self.stl(),
            Kind::Text => self.text(),
            Kind::Floats | Kind::Doubles => self.binary_ply(kind == Kind::Doubles),
        }
    }

    fn binary_ply(&self, double: bool) -> Vec<u8> {
        let scalar = if double { "double" } else { "float" };
        let mut bytes = header("binary_little_endian", scalar, self.positions.len(), self.faces.len()).into_bytes();
        for x in self.positions.as_flattened() {
            if double {
                bytes.extend(x.to_le_bytes());
            } else {
                bytes.extend((*x as f32).to_le_bytes());
            }
        }
        for face in &self.faces {
            bytes.push(3);
            bytes.extend(face.map(u32::to_le_bytes).as_flattened());
        }
        bytes
    }

    fn text(&self) -> Vec<u8> {
        let mut text = header("ascii", "float", self.positions.len(), self.faces.len());
        for p in &self.positions {
            let [x, y, z] = p.map(|x| x as f32);
            text += &format!("{x} {y} {z}\n");
        }
        for [a, b, c] in &self.faces {
            text += &format!("3 {a} {b} {c}\n");
        }
        text.into_bytes()
    }

    fn stl(&self) -> Vec<u8> {
        let mut bytes = vec![b' '; 80];
        bytes.extend((self.faces.len() as u32).to_le_bytes());
        for face in &self.faces {
            bytes.extend([0; 12]);
            for v in face {
                bytes.extend(self.positions[*v as usize].map(|x| (x as f32).to_le_bytes()).as_flattened());
            }
            bytes.extend([0; 2]);
        }
        bytes
    }

    /// Reads what the program writes: binary PLY of floats or doubles, without a spare byte.
    pub fn read(path: &Path) -> Mesh {
        let bytes = fs::read(path).unwrap();
        let end = find(&bytes, b"end_header\n").unwrap() + b"end_header\n".len();
        let head = std::str::from_utf8(&bytes[..end]).unwrap();
        assert!(head.starts_with("ply\nformat binary_little_endian 1.0\n"), "{head}");
        let double = head.contains("property double x\n");
        let count = |what: &str| -> usize {
            let line = head.lines().find_map(|l| l.strip_prefix(&format!("element {what} "))).unwrap();
            line.parse().unwrap()
        };
        let (vertices, faces) = (count("vertex"), count("face"));
        let (coordinates, corners) = bytes[end..].split_at(vertices * if double { 24 } else { 12 });
        let numbers: Vec<f64> = if double {
            coordinates.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect()
        } else {
            coordinates.as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect()
        };
        assert_eq!(corners.len(), 13 * faces, "bytes behind the last face, or too few");
        let face = |record: &[u8; 13]| {
            assert_eq!(record[0], 3);
            [1, 5, 9].map(|at| u32::from_le_bytes(record[at..at + 4].try_into().unwrap()))
        };
        let mesh =
            Mesh { positions: numbers.as_chunks().0.to_vec(), faces: corners.as_chunks().0.iter().map(face).collect() };
        mesh.check();
        mesh
    }

    /// What holds for whatever the program writes.
    fn check(&self) {
        let mut used = vec![false; self.positions.len()];
        for &[a, b, c] in &self.faces {
            assert!(a != b && b != c && c != a, "a face repeats a corner");
            [a, b, c].iter().for_each(|v| used[*v as usize] = true);
        }
        assert!(used.iter().all(|u| *u), "a vertex that no face uses");
        assert!(self.positions.as_flattened().iter().all(|x| x.is_finite()));
    }

    /// Edges of one face, as the face goes along them.
    pub fn border(&self) -> Vec<[u32; 2]> {
        let mut edges: Vec<([u32; 2], [u32; 2])> = Vec::with_capacity(3 * self.faces.len());
        for &[a, b, c] in &self.faces {
            edges.extend([[a, b], [b, c], [c, a]].map(|[u, v]| ([u.min(v), u.max(v)], [u, v])));
        }
        edges.sort_unstable();
        edges.chunk_by(|e, f| e.0 == f.0).filter(|same| same.len() == 1).map(|same| same[0].1).collect()
    }

    /// Least and largest coordinates.
    pub fn extent(&self) -> [[f64; 3]; 2] {
        let start = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
        self.positions.iter().fold(start, |[mut low, mut high], p| {
            for axis in 0..3 {
                low[axis] = low[axis].min(p[axis]);
                high[axis] = high[axis].max(p[axis]);
            }
            [low, high]
        })
    }

    pub fn diagonal(&self) -> f64 {
        let [low, high] = self.extent();
        (0..3).map(|axis| (high[axis] - low[axis]).powi(2)).sum::<f64>().sqrt()
    }
}

fn header(format: &str, scalar: &str, vertices: usize, faces: usize) -> String {
    format!(
        "ply\nformat {format} 1.0\nelement vertex {vertices}\nproperty {scalar} x\nproperty {scalar} y\n\
         property {scalar} z\nelement face {faces}\nproperty list uchar uint vertex_indices\nend_header\n"
    )
}

pub fn find(bytes: &[u8], what: &[u8]) -> Option<usize> {
    bytes.windows(what.len()).position(|w| w == what)
}

/// A folder for one test, empty at first and gone at the end.
pub struct Folder(TempDir);

impl Folder {
    pub fn new() -> Self {
        Folder(tempfile::tempdir().unwrap())
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Writes a file.
    pub fn file(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        fs::write(self.path(name), bytes).unwrap();
        self.path(name)
    }

    /// Writes a mesh as a scan.
    pub fn scan(&self, name: &str, mesh: &Mesh, kind: Kind) -> PathBuf {
        self.file(&format!("{name}.{}", kind.extension()), mesh.bytes(kind))
    }

    /// A scan that the program makes.
    pub fn synth(&self, name: &str, faces: &str) -> PathBuf {
        let path = self.path(name);
        let status = program().arg("synth").arg(&path).args(["--faces", faces, "--seed", "7"]).output().unwrap().status;
        assert!(status.success());
        path
    }

    /// Names of all there is, sorted.
    pub fn names(&self) -> Vec<String> {
        let mut names: Vec<String> =
            fs::read_dir(self.0.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    /// Reduces to `out.ply`, with a report in JSON.
    pub fn reduce(&self, scan: &Path, args: &[&str]) -> Outcome {
        self.reduce_to("out.ply", scan, args)
    }

    /// Reduces to ASCII PLY: the report, and the text.
    pub fn reduce_to_text(&self, scan: &str, args: &[&str]) -> (Value, String) {
        let out = self.path("out.ply");
        let mut command = program();
        command.arg("reduce").arg(self.path(scan)).arg("-o").arg(&out).args(["--format", "ply-ascii", "--json"]);
        let output = command.args(args).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
        (serde_json::from_slice(&output.stdout).unwrap(), fs::read_to_string(out).unwrap())
    }

    /// Reduces to a file of this name.
    pub fn reduce_to(&self, out: &str, scan: &Path, args: &[&str]) -> Outcome {
        let mut command = program();
        command.arg("reduce").arg(scan).arg("-o").arg(self.path(out)).args(args).arg("--json");
        Outcome::of(command, self.path(out))
    }
}

/// The program, not yet run.
pub fn program() -> Command {
    Command::new(assert_cmd::cargo::cargo_bin("meshmill"))
}

/// What a run with `--json` came to.
#[derive(Debug)]
pub struct Outcome {
    pub code: Option<i32>,
    /// All of stdout.
    pub object: Value,
    pub stderr: String,
    out: PathBuf,
}

impl Outcome {
    pub fn of(mut command: Command, out: PathBuf) -> Self {
        let output = command.output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        let object = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| {
            panic!("stdout is no JSON ({e}): {} / {stderr}", String::from_utf8_lossy(&output.stdout));
        });
        Outcome { code: output.status.code(), object, stderr, out }
    }

    /// Requires success in this mode; that the report tells what was written, and the budget was kept.
    #[track_caller]
    pub fn done(self, mode: &str) -> Done {
        assert_eq!(self.code, Some(0), "{}", self.stderr);
        let mesh = Mesh::read(&self.out);
        let report = self.object;
        assert_eq!(report["mode"], mode, "{report}");
        assert_eq!(report["output"]["faces"], mesh.faces.len(), "{report}");
        assert_eq!(report["output"]["vertices"], mesh.positions.len(), "{report}");
        if let (Some(peak), Some(budget)) = (report["peak_rss_bytes"].as_u64(), report["memory_budget_bytes"].as_u64())
        {
            assert!(peak <= budget, "{peak} bytes resident, {budget} allowed: {report}");
        }
        Done { mesh, report, bytes: fs::read(self.out).unwrap() }
    }

    /// Requires failure with this exit code, said once in words and once in JSON; the message.
    #[track_caller]
    pub fn failed(&self, code: i32) -> String {
        assert_eq!(self.code, Some(code), "{} {}", self.stderr, self.object);
        let error = &self.object["error"];
        let message = error["message"].as_str().unwrap_or_else(|| panic!("no message: {}", self.object)).to_string();
        assert!(error["code"].is_string() && self.object["schema"] == 1, "{}", self.object);
        assert!(!message.contains("panicked") && !self.stderr.contains("panicked"), "{}", self.stderr);
        assert_eq!(self.stderr, format!("meshmill: {message}\n"), "one line and no other");
        assert!(!message.contains('\n') && message.len() < 500, "{message}");
        message
    }
}

/// A reduction that succeeded.
#[derive(Debug)]
pub struct Done {
    pub mesh: Mesh,
    pub report: Value,
    pub bytes: Vec<u8>,
}

impl Done {
    pub fn faces(&self) -> usize {
        self.mesh.faces.len()
    }

    /// The text of the warning with this code.
    pub fn warning(&self, code: &str) -> Option<&str> {
        let warnings = self.report["warnings"].as_array().unwrap();
        warnings.iter().find(|w| w["code"] == code).and_then(|w| w["text"].as_str())
    }

    /// Codes of all warnings, sorted.
    pub fn warnings(&self) -> Vec<&str> {
        let warnings = self.report["warnings"].as_array().unwrap();
        let mut codes: Vec<&str> = warnings.iter().map(|w| w["code"].as_str().unwrap()).collect();
        codes.sort();
        codes
    }
}
