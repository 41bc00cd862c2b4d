//! What a reduced mesh stands for.

use super::IndexedMesh;

/// The finer mesh that a reduced one was made from, and where each of its vertices went.
#[derive(Debug, Clone, PartialEq)]
pub struct Reference<S> {
    /// The finer mesh, in the same frame.
    pub mesh: IndexedMesh<S>,
    /// For each of its vertices the vertex of the reduced mesh that it became; [`u32::MAX`] if that has vanished with its
    /// faces.
    pub homes: Vec<u32>,
}
