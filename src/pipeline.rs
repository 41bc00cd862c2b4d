//! read → cluster → collapse → write: the order in which a scan goes through the mill.

use crate::error::{Error, Result};
use crate::job::Job;
use crate::progress::Progress;
use crate::report::Report;

/// Reduces one scan as `job` says, and reports.
pub fn reduce(job: &Job, _progress: &Progress) -> Result<Report> {
    Err(Error::Unmet { file: job.input.clone(), what: "this build has no stages yet".into() })
}
