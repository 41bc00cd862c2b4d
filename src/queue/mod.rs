//! The night: many scans, one after another and side by side, each in a process of its own kind of peril.
//!
//! [`Plan`] says what will be done: which scans, to what, in which order, within which limits; [`Plan::check`] refuses what
//! cannot work before anything starts. [`Night`] does it. Scans are reduced by *workers*, processes of this same program
//! that take one task after another over a pipe: what kills one (a crash, the system's out-of-memory killer, SIGBUS from a
//! file that is cut short) costs the scan that it had, which gets a row in the report that says so, and a new worker takes
//! the next. The *ledger* ([`Ledger`]) has a line, checked and synced, for every scan that is begun and finished: the same
//! command resumes a night that was ended anyhow, whatever it was.
//!
//! **Promises.** A finished scan is not done again while its input, its options and its results are what the ledger says.
//! Every result is whole or absent. A second run on the same folder is refused while the first lives. All processes
//! together stay within the night's memory: each scan has a budget that the plan fixes, as many run as fit, and one whose
//! resident set outgrows its budget is ended.
//!
//! **Does not promise** to know what another program does to the memory of the machine, or that a scan on which a worker
//! was when the night was killed is not begun again.

mod clock;
mod crew;
mod expand;
mod glance;
mod ledger;
mod night;
mod plan;
mod process;
mod report;
mod schedule;
mod template;
mod worker;

pub use clock::{Deadline, local_time};
pub use glance::Glance;
pub use ledger::{Fingerprint, Ledger, Lock};
pub use night::{Night, Watcher};
pub use plan::{Plan, PlanOptions, Problem, Shard, Task, TaskFacts};
pub use process::{reset_peak, rss_bytes, this_program};
pub use report::{NightReport, OutputFile, Row, Status, Totals, Trouble, merge};
pub use schedule::{Running, Standing};
pub use worker::work;
