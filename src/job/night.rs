//! `[night]`: how a queue of scans is gone through.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use super::quantity::{Count, Threads, as_written, write_size};
use crate::budget::Size;

/// `[night]`
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NightTable {
    /// The folder of the ledger, the reports and their pictures.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub folder: Option<PathBuf>,
    /// Bound on the peak resident set of all processes together.
    #[serde(default, deserialize_with = "as_written", serialize_with = "write_size")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
    /// Scans that are reduced side by side, at most.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub workers: Option<Threads>,
    /// Which scans come first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub order: Option<Order>,
    /// How long one scan may take.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub scan_time: Option<Span>,
    /// When the night is over: nothing is begun that would not be done by then.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub stop_at: Option<TimeOfDay>,
    /// How often a scan is tried again after a failure that may pass.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub retries: Option<Count>,
    /// Whether a scan for which the system had not enough memory is tried again with half its budget.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retry_with_less: Option<bool>,
    /// Whether pictures are taken for the report.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pictures: Option<bool>,
}

/// Which scans of a queue come first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// The largest: the night ends soonest.
    #[default]
    BigFirst,
    /// The smallest: the most is done early.
    SmallFirst,
    /// As they are named and listed.
    Name,
}

/// A length of time: `90s`, `45min` or `2h`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    /// In seconds.
    pub seconds: f64,
}

impl FromStr for Span {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        let split = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
        let factor = match text[split..].trim() {
            "" | "s" => 1.0,
            "min" => 60.0,
            "h" => 3600.0,
            _ => f64::NAN,
        };
        let seconds = text[..split].trim().parse().unwrap_or(f64::NAN) * factor;
        if seconds > 0.0 && seconds < 1e9 {
            return Ok(Span { seconds });
        }
        Err(format!("`{text}` is not a length of time: write it like 90s, 45min or 2h"))
    }
}

impl fmt::Display for Span {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.seconds {
            s if s % 3600.0 == 0.0 => write!(f, "{}h", s / 3600.0),
            s if s % 60.0 == 0.0 => write!(f, "{}min", s / 60.0),
            s => write!(f, "{s}s"),
        }
    }
}

/// A time of day, local: `06:30`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimeOfDay {
    /// From midnight.
    pub minutes: u16,
}

impl FromStr for TimeOfDay {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |text: &str, most: u16| text.parse::<u16>().ok().filter(|n| *n < most && text.len() == 2);
        let parts = text.trim().split_once(':');
        match parts.and_then(|(hours, minutes)| Some((number(hours, 24)?, number(minutes, 60)?))) {
            Some((hours, minutes)) => Ok(TimeOfDay { minutes: 60 * hours + minutes }),
            None => Err(format!("`{text}` is not a time of day: write it like 06:30")),
        }
    }
}

impl fmt::Display for TimeOfDay {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:02}:{:02}", self.minutes / 60, self.minutes % 60)
    }
}

/// Written as they are read.
macro_rules! in_words {
    ($($quantity:ty),*) => {$(
        impl Serialize for $quantity {
            fn serialize<S: serde::Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
                out.collect_str(self)
            }
        }
    )*};
}
in_words!(Span, TimeOfDay);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_and_times_read_as_people_write_them() {
        for (text, seconds) in [("90s", 90.0), ("45min", 2700.0), ("2 h", 7200.0), ("1.5h", 5400.0), ("30", 30.0)] {
            let span: Span = text.parse().unwrap();
            assert_eq!(span.seconds, seconds);
            assert_eq!(span.to_string().parse(), Ok(span));
        }
        for text in ["", "h", "2 days", "-1s", "0s", "inf"] {
            assert!(text.parse::<Span>().is_err(), "{text}");
        }
        let time: TimeOfDay = "06:30".parse().unwrap();
        assert_eq!((time.minutes, time.to_string().as_str()), (390, "06:30"));
        for text in ["6:30", "24:00", "06:60", "0630", "06:30:00", "", "-1:00"] {
            assert!(text.parse::<TimeOfDay>().is_err(), "{text}");
        }
    }
}
