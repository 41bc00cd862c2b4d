//! Deviations as colours.

/// Colours for lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    /// The length of the last colour; what is longer has it too.
    pub top: f64,
}
