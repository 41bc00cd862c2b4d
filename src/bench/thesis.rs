//! What the thesis reports: Table 6.3, complete decimation to 0 faces, seconds without input and output.

use serde::Serialize;

/// A group of Figures 6.2 to 6.4.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Group {
    /// Fewer than 15,000 faces (Figure 6.2).
    Small,
    /// 15,000 to 150,000 or so (Figure 6.3).
    Medium,
    /// More than 400,000 (Figure 6.4).
    Large,
}

/// A row of Table 6.3.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ThesisRow {
    /// The model, as the thesis calls it.
    pub model: &'static str,
    /// Its file's name, without ending.
    #[serde(skip)]
    pub file: &'static str,
    /// Vertices.
    pub vertices: u64,
    /// Faces.
    pub faces: u64,
    /// Seconds until the first collapse.
    pub initialisation: f64,
    /// Seconds from there.
    pub simplification: f64,
    /// The machine.
    pub machine: &'static str,
}

const PENTIUM_PRO: &str = "PentiumPro, 200 MHz";
const R10000: &str = "R10000, 195 MHz";

/// Bytes a vertex that the thesis's program takes (Table 6.2).
pub const BYTES_A_VERTEX: f64 = 268.0;

/// Table 6.3.
pub const TABLE: [ThesisRow; 12] = [
    row("Blobby “V”", "blobby_v", [1923, 3842], [0.129, 0.168], PENTIUM_PRO),
    row("Cow", "cow", [2904, 5804], [0.198, 0.269], PENTIUM_PRO),
    row("Sphere", "sphere", [4004, 8004], [0.294, 0.361], PENTIUM_PRO),
    row("Exchanger", "exchanger", [5500, 11_036], [0.38, 0.548], PENTIUM_PRO),
    row("Face", "face", [14_445, 28_906], [1.02, 1.632], PENTIUM_PRO),
    row("Brontosaur", "brontosaur", [23_984, 47_904], [1.749, 2.916], PENTIUM_PRO),
    row("Bunny", "bunny", [34_834, 69_451], [2.612, 4.435], PENTIUM_PRO),
    row("Dragon", "dragon", [54_296, 108_588], [3.685, 7.087], PENTIUM_PRO),
    row("Femur", "femur", [76_794, 153_322], [5.447, 10.048], PENTIUM_PRO),
    row("Teeth", "teeth", [212_192, 424_376], [11.83, 43.76], R10000),
    row("Buddha", "buddha", [543_644, 1_085_634], [33.75, 149.10], R10000),
    row("Turbine", "turbine", [882_954, 1_765_388], [52.16, 257.93], R10000),
];

const fn row(
    model: &'static str,
    file: &'static str,
    [vertices, faces]: [u64; 2],
    [initialisation, simplification]: [f64; 2],
    machine: &'static str,
) -> ThesisRow {
    ThesisRow { model, file, vertices, faces, initialisation, simplification, machine }
}

impl ThesisRow {
    /// Seconds in all.
    pub fn total(&self) -> f64 {
        self.initialisation + self.simplification
    }

    /// The figure that it is in.
    pub fn group(&self) -> Group {
        match self.faces {
            0..15_000 => Group::Small,
            15_000..200_000 => Group::Medium,
            _ => Group::Large,
        }
    }
}
