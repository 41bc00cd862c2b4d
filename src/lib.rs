//! meshmill reduces huge scans in fixed memory.

pub mod budget;
pub mod error;
pub mod mesh;
pub mod progress;
pub mod quadric;
pub mod read;

pub use error::{Error, Result};
