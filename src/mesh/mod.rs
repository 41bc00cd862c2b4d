//! The meshes that pass between stages, and the frame in which their coordinates live.

mod frame;
mod indexed;
mod weld;

pub use frame::{Coordinate, Extent, Frame};
pub use indexed::{IndexedMesh, narrow, widen};
pub(crate) use weld::hash_position;
pub use weld::{WeldReport, weld};
