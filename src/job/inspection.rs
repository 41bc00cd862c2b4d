//! An inspection: what was said on the command line, and what will be done.

use std::path::{Path, PathBuf};

use super::{Count, DEFAULT_MEMORY, Ratio, Target, Threads, cores};
use crate::budget::Size;
use crate::scratch::DEFAULT_QUOTA;

/// What a reduction is taken to be to when nobody says: the hundredth part.
const USUAL_TARGET: Target = Target::Ratio(0.01);

/// An inspection as it was said.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct InspectionSaid {
    /// The scan.
    pub input: PathBuf,
    /// Faces that it might be reduced to.
    pub faces: Option<Count>,
    /// The share of its faces that it might be reduced to.
    pub ratio: Option<Ratio>,
    /// Bound on the peak resident set.
    pub memory: Option<Size>,
    /// Worker threads.
    pub threads: Option<Threads>,
    /// Folder for spills.
    pub scratch: Option<PathBuf>,
    /// What may be in that folder at one time.
    pub scratch_quota: Option<Size>,
}

/// An inspection with every default filled in.
#[derive(Debug, Clone, PartialEq)]
pub struct Inspection {
    /// The scan.
    pub input: PathBuf,
    /// What it might be reduced to.
    pub target: Target,
    /// Bound on the whole process's peak resident set.
    pub memory: Size,
    /// Worker threads, at least 1; changes nothing in what is found.
    pub threads: usize,
    /// Folder for spills.
    pub scratch: PathBuf,
    /// What may be in it at one time.
    pub scratch_quota: Size,
}

impl InspectionSaid {
    /// Fills in the defaults. Spills go to the folder that the program runs in.
    pub fn resolve(self) -> Inspection {
        let target = match (self.faces, self.ratio) {
            (Some(Count(n)), _) => Target::Faces(n),
            (None, Some(Ratio(r))) => Target::Ratio(r),
            (None, None) => USUAL_TARGET,
        };
        Inspection {
            input: self.input,
            target,
            memory: self.memory.unwrap_or(DEFAULT_MEMORY),
            threads: self.threads.map_or_else(cores, |Threads(n)| n),
            scratch: self.scratch.unwrap_or_else(|| Path::new(".").into()),
            scratch_quota: self.scratch_quota.unwrap_or(DEFAULT_QUOTA),
        }
    }
}
