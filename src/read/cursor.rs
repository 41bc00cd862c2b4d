//! A place in the file that moves forward: for what has to be read in order.

use super::map::{Input, WINDOW_BYTES, Window};
use crate::error::Result;
use crate::progress::Progress;

/// Sees the file through one window at a time.
#[derive(Debug)]
pub(super) struct Cursor<'a> {
    input: &'a Input,
    progress: &'a Progress,
    window: Option<Window>,
    /// The next byte.
    pub at: u64,
}

impl<'a> Cursor<'a> {
    /// A cursor at byte `at`.
    pub fn new(input: &'a Input, progress: &'a Progress, at: u64) -> Self {
        Cursor { input, progress, window: None, at }
    }

    /// The bytes from `at` on that are at hand: at least `need`, unless the file ends before. `need` is at most a window.
    #[inline(always)]
    pub fn bytes(&mut self, need: usize) -> Result<&[u8]> {
        let at_hand = self.window.as_ref().is_some_and(|w| {
            let (skipped, len) = (self.at.wrapping_sub(w.from()), w.len() as u64);
            skipped.saturating_add(need as u64) <= len || (skipped <= len && w.from() + len == self.input.len())
        });
        if !at_hand {
            self.remap()?;
        }
        Ok(match &self.window {
            Some(window) => &window[(self.at - window.from()) as usize..],
            None => &[],
        })
    }

    /// The `len` bytes before the cursor, which were at hand before it moved over them.
    #[inline(always)]
    pub fn behind(&self, len: usize) -> &[u8] {
        match &self.window {
            Some(window) => {
                let end = (self.at - window.from()) as usize;
                &window[end - len..end]
            }
            None => &[],
        }
    }

    /// Bytes between the cursor and the end of the file.
    pub fn left(&self) -> u64 {
        self.input.len().saturating_sub(self.at)
    }

    #[cold]
    fn remap(&mut self) -> Result<()> {
        self.window = None;
        self.progress.check()?;
        let len = self.left().min(WINDOW_BYTES as u64) as usize;
        if len > 0 {
            self.window = Some(self.input.window(self.at, len)?);
        }
        Ok(())
    }
}
