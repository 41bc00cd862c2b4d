//! meshmill reduces huge scans in fixed memory.

pub mod budget;
pub mod collapse;
pub mod error;
pub mod mesh;
pub mod progress;
pub mod quadric;

pub use error::{Error, Result};
