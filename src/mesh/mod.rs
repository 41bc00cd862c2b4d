//! The meshes that pass between stages, and the frame in which their coordinates live.

pub mod adjacency;
mod frame;
mod indexed;
mod reference;
mod weld;

pub use frame::{Coordinate, Extent, Frame};
pub use indexed::{IndexedMesh, narrow, step, widen};
pub use reference::Reference;
pub(crate) use weld::{BATCH, PositionTable};
pub use weld::{WeldReport, weld};
