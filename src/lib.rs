//! meshmill reduces huge scans in fixed memory.

pub mod budget;
pub mod cluster;
pub mod error;
pub mod mesh;
pub mod progress;
pub mod quadric;
pub mod read;
pub mod scratch;
pub mod synth;
pub mod write;

pub use error::{Error, Result};
