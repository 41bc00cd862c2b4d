//! A mesh that memory does not hold, cut up on scratch: tiles of it are loaded, worked on and put back.
//!
//! Space is divided into *blocks*; a *tile* is a cube of 8³ of them, and tiles lie in either of two ways, half a tile
//! apart, so that what is at the cut of one sweep is inside a tile of the next. A face is in the block of its centroid
//! and brings the positions of its corners along: vertices are found again by their positions, which stay the same to
//! the bit wherever two tiles share them ([`Tile::locked`]). So nothing is numbered across tiles, and no crack can
//! open.
//!
//! **Promises.** What a tile holds depends on the mesh alone, not on who wrote it when: faces are put in order, along a
//! curve through space, as they are loaded. Nothing is held for the whole mesh but where the records of blocks are.
//!
//! **Memory.** [`loading_bytes`] a face of a tile; what a writer is given; 16 bytes for each run of records, twice as
//! many while lists grow: one for each time that a block (of small ones, a cube of 4³) is among what a writer holds.
//! **Scratch:** 36 bytes a face (72 in doubles), and 24 (36) for each corner of a face that lies in another cube of 4³
//! blocks than the face: few. Samples take [`sample_bytes`] each.

mod grid;
mod partition;
mod sampling;
mod store;

pub use grid::{Blocks, FEW_FACES, Lie, blocks};
pub(crate) use partition::welded;
pub use partition::{Cut, Cutter, Partition, Place, Tile, Tiles, loading_bytes};
pub use sampling::{SampleStore, SampleTiles, draw, record_bytes as sample_bytes};
pub use store::Group;
