//! The meshes that pass between stages, the frame in which their coordinates live, and what is asked of them.

pub mod adjacency;
pub mod audit;
pub mod boxes;
pub mod coat;
pub mod columns;
mod frame;
pub mod groups;
mod indexed;
pub mod marked;
mod mix;
mod reference;
pub mod samples;
pub mod tree;
pub mod triangle;
mod wedges;
mod weld;

pub use frame::{Coordinate, Extent, Frame};
pub use indexed::{IndexedMesh, narrow, step, widen};
pub(crate) use indexed::{number_used, renumber};
pub(crate) use mix::mix;
pub use reference::Reference;
pub use samples::{SampleFile, SurfaceSamples};
pub use tree::{Nearest, Tree};
pub use wedges::{Shades, Wedges};
pub(crate) use weld::{BATCH, PositionTable};
pub use weld::{WeldReport, weld};
