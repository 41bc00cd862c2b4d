//! meshmill reduces huge scans in fixed memory.

pub mod budget;
pub mod cluster;
pub mod collapse;
pub mod error;
pub mod job;
pub mod mesh;
pub mod pipeline;
pub mod plan;
pub mod progress;
pub mod quadric;
pub mod read;
pub mod report;
pub mod scratch;
pub mod synth;
pub mod write;

pub use error::{Error, Result};
