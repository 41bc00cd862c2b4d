//! What can go wrong, said once: file, item, byte, found, expected.
//!
//! The library returns these; only `main` prints them. [`Error::exit_code`] is the contract with scripts.

use std::path::{Path, PathBuf};

/// Everything that ends a run early.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The bytes of an input are not what its format promises.
    #[error("{}: {what}", Place { file, item: item.as_ref(), byte: *byte })]
    Input {
        /// The input.
        file: PathBuf,
        /// The element that is wrong, e.g. `face 18442901` (counted from 0).
        item: Option<Item>,
        /// Offset of the first wrong byte in the file.
        byte: Option<u64>,
        /// What was found and what was expected.
        what: String,
    },
    /// The operating system refused: open, map, write, sync, rename.
    #[error("{}: {action}: {source}", file.display())]
    Io {
        /// The file or folder in question.
        file: PathBuf,
        /// What was being done, e.g. `cannot write`.
        action: &'static str,
        /// The system's own words.
        source: std::io::Error,
    },
    /// The command line or the job file is wrong.
    #[error("{what}")]
    Usage {
        /// What is wrong, and how to say it right.
        what: String,
        /// The job file, where it is one.
        file: Option<PathBuf>,
    },
    /// The memory budget cannot do what is asked; nothing was begun.
    #[error("{what}: --memory {} would do", crate::budget::Size(*needed_bytes))]
    Budget {
        /// What does not fit in what.
        what: String,
        /// A budget that works.
        needed_bytes: u64,
    },
    /// The run was sound, but what was asked cannot be had from this scan.
    #[error("{}: {what}", file.display())]
    Unmet {
        /// The input.
        file: PathBuf,
        /// What was asked and the nearest that can be had.
        what: String,
    },
    /// A signal asked the run to end.
    #[error("interrupted by signal {signal}; {left}")]
    Interrupted {
        /// SIGINT (2) or SIGTERM (15).
        signal: i32,
        /// What the run leaves.
        left: &'static str,
    },
}

/// The result of anything that can fail here.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// An element of a file: its kind and its number, counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Item {
    /// `vertex`, `face`, `header line`, …
    pub kind: &'static str,
    /// Position among its kind.
    pub ordinal: u64,
}

struct Place<'a> {
    file: &'a Path,
    item: Option<&'a Item>,
    byte: Option<u64>,
}

impl std::fmt::Display for Place<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.file.display())?;
        match (self.item, self.byte) {
            (Some(i), Some(b)) => write!(f, ": {} {} (byte {b})", i.kind, i.ordinal),
            (Some(i), None) => write!(f, ": {} {}", i.kind, i.ordinal),
            (None, Some(b)) => write!(f, ": byte {b}"),
            (None, None) => Ok(()),
        }
    }
}

impl Error {
    /// An input error that concerns the file as a whole.
    pub fn input(file: &Path, what: impl Into<String>) -> Self {
        Error::Input { file: file.into(), item: None, byte: None, what: what.into() }
    }

    /// An input error at an item and a byte.
    pub fn input_at(file: &Path, item: Item, byte: u64, what: impl Into<String>) -> Self {
        Error::Input { file: file.into(), item: Some(item), byte: Some(byte), what: what.into() }
    }

    /// Wraps a system error with the file and what was being done to it.
    pub fn io(file: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> Self {
        let file = file.to_path_buf();
        move |source| Error::Io { file, action, source }
    }

    /// A wrong command line.
    pub fn usage(what: impl Into<String>) -> Self {
        Error::Usage { what: what.into(), file: None }
    }

    /// The process's exit code: 1 a scan failed or an ask was not met, 2 the command, the job file or the budget is
    /// wrong, 130 and 143 after SIGINT and SIGTERM.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Input { .. } | Error::Io { .. } | Error::Unmet { .. } => 1,
            Error::Usage { .. } | Error::Budget { .. } => 2,
            Error::Interrupted { signal, .. } => 128u8.wrapping_add(*signal as u8),
        }
    }

    /// A stable word for scripts.
    pub fn code(&self) -> &'static str {
        match self {
            Error::Input { .. } => "bad-input",
            Error::Io { .. } => "io",
            Error::Usage { .. } => "usage",
            Error::Budget { .. } => "budget",
            Error::Unmet { .. } => "unmet",
            Error::Interrupted { .. } => "interrupted",
        }
    }

    /// The file that the error is about.
    pub fn file(&self) -> Option<&Path> {
        match self {
            Error::Input { file, .. } | Error::Io { file, .. } | Error::Unmet { file, .. } => Some(file),
            Error::Usage { file, .. } => file.as_deref(),
            Error::Budget { .. } | Error::Interrupted { .. } => None,
        }
    }

    /// The byte of that file, where one is to blame.
    pub fn byte(&self) -> Option<u64> {
        match self {
            Error::Input { byte, .. } => *byte,
            _ => None,
        }
    }
}
