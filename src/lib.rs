//! meshmill reduces huge scans to the face count that is asked for, in fixed memory, and says how far it went.
//!
//! ```text
//!            ┌ fits the budget ──→ load, weld ──────────────────┐
//!  scan ─→ read                                                 ├─→ collapse ─→ refit ─→ write
//!            ├ does not ──→ cluster: bin, sum, place, carry ────┘
//!            │              quadrics over
//!            └ nor does what is asked ──→ tiles ⇄ collapse ─→ refit ─→ join ─→ write
//!
//!  two meshes ─→ read ─→ measure: hold the smaller, stream the larger
//! ```
//!
//! One module a stage; [`pipeline`] is their order, [`plan`] decides what a budget buys.
//!
//! | module | takes | gives |
//! |---|---|---|
//! | [`read`] | a mapped file of any format, unpacked if need be | chunks of vertices, triangles or soup; or the whole scan, welded |
//! | [`cluster`] | those chunks | an intermediate mesh of about ten times the result's size, a quadric a vertex, samples of the surface |
//! | [`tiles`] | those chunks, or a mesh | the same cut up on scratch, a tile at a time |
//! | [`collapse`] | a mesh, quadrics | the mesh that was asked for |
//! | [`refit`] | that mesh, and samples of the scan or a finer mesh | the same mesh, closer to the scan |
//! | [`carry`] | the scan, that mesh | what vertices, corners and faces carry, for the mesh's |
//! | [`write`](mod@write) | a mesh | a file that appears whole or not at all |
//! | [`measure`] | two scans | how far they are from each other, both ways |
//! | [`inspect`] | a scan | counts of what is in it and of what is wrong with it |
//! | [`picture`] | a scan, a camera | what it looks like |
//! | [`synth`] | a count and a seed | a scan to try all this on |
//! | [`bench`](mod@bench) | models, or counts | how long stages take, beside Garland's thesis |
//!
//! **Direction.** `main` → [`job`], [`pipeline`] → [`plan`] → stages → [`mesh`], [`quadric`], [`scratch`], [`budget`],
//! [`progress`], `cores`, `vectors` → [`error`]. Stages do not import one another, save that `cluster`, `carry`, `measure`, `inspect` and `picture`
//! stream through `read`, `measure`, `tiles` and the votes of `carry` by way of `facets`, which brings faces the positions of their corners; none of them knows [`job`] or [`report`]. The library is silent: stages count, `report` words, `main` prints.
//!
//! **Invariant:** the same scan, options and budget give the same bytes, whatever the threads and the machine. Chunks and
//! tables are sized from the scan and the budget; what threads share is summed in integers; every step of the collapse is a
//! function of the state before it. Hot loops are compiled for vectors of several widths, the processor's is chosen at run
//! time, and each does the same operations in the same order, none of them fused.
//!
//! **Invariant:** the process's peak resident set stays within the budget, input and output pages included. Each stage's
//! documentation has its bytes a face, a vertex or a cell; [`plan`] adds them up before anything is read.
//!
//! **Invariant:** nothing is allocated on a file's word. Counts are held against the file's size first.
//!
//! **Invariant:** no constant knows the size or place of a scan. Coordinates are scaled by a power of two into a
//! [`mesh::Frame`], which begins near them where they are doubles far away, and kept in the scalar that the file has;
//! arithmetic is done in `f64` on differences.
//!
//! Words: *soup*, triangles without shared vertices. *Weld*, make one vertex of coincident ones. *Cell*, a cube of the
//! clustering grid; *representative*, its vertex. *Wedge*, a vertex as one side of a seam sees it. *Quadric*, squared distance to weighted planes. *Candidate*, an edge that
//! could be collapsed; *cost*, its quadric's value: squared length times area. *Batch*, collapses applied together. *Spill*,
//! what memory does not hold, in a scratch file. *Deviation*, a measured length; *error*, an estimated one or a failure.
//! *Budget*, bytes.

pub mod bench;
pub mod budget;
pub mod carry;
pub mod cluster;
pub mod collapse;
mod cores;
pub mod error;
mod facets;
pub mod inspect;
pub mod job;
pub mod measure;
pub mod mesh;
pub mod morning;
pub mod picture;
pub mod pipeline;
pub mod plan;
pub mod progress;
pub mod quadric;
pub mod queue;
pub mod read;
pub mod refit;
pub mod report;
pub mod scratch;
pub mod synth;
pub mod tiles;
mod vectors;
pub mod write;

pub use error::{Error, Result};
