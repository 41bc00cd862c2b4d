//! Times of day, and when a night is over.

use crate::job::TimeOfDay;
use jiff::{Span, Timestamp, Zoned};

/// When a night is over.
#[derive(Debug, Clone, PartialEq)]
pub struct Deadline {
    at: Timestamp,
}

impl Deadline {
    /// The next time that it is this time of day, here.
    pub fn next(time: TimeOfDay) -> Deadline {
        Deadline { at: next_after(&Zoned::now(), time).timestamp() }
    }

    /// Seconds until then; negative afterwards.
    pub fn seconds_left(&self) -> f64 {
        self.at.duration_since(Timestamp::now()).as_secs_f64()
    }
}

fn next_after(now: &Zoned, time: TimeOfDay) -> Zoned {
    let at = |day: jiff::civil::Date| {
        let (hour, minute) = ((time.minutes / 60) as i8, (time.minutes % 60) as i8);
        // A time that a change of clocks leaves out is as long after midnight as it sounds.
        day.at(hour, minute, 0, 0).to_zoned(now.time_zone().clone())
    };
    let tomorrow = || now.checked_add(Span::new().days(1)).and_then(|day| at(day.date()));
    match at(now.date()) {
        Ok(today) if today > *now => today,
        _ => tomorrow().unwrap_or_else(|_| now.clone()),
    }
}

/// Seconds since 1970.
pub(super) fn now() -> f64 {
    Timestamp::now().as_duration().as_secs_f64()
}

/// `2026-11-22 06:30:12`, here.
pub fn local_time(seconds: f64) -> String {
    match Timestamp::from_microsecond((seconds * 1e6) as i64) {
        Ok(time) => time.to_zoned(jiff::tz::TimeZone::system()).strftime("%Y-%m-%d %H:%M:%S").to_string(),
        Err(_) => String::from("unknown"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use jiff::civil::DateTime;
    use jiff::tz::TimeZone;

    #[test]
    fn a_night_ends_at_the_next_such_time() {
        // Paris, without a database of time zones.
        let zone = TimeZone::posix("CET-1CEST,M3.5.0,M10.5.0/3").unwrap();
        let at = |text: &str| text.parse::<DateTime>().unwrap().to_zoned(zone.clone()).unwrap();
        let morning = TimeOfDay { minutes: 390 };
        for (now, end) in [
            ("2026-11-22T20:00:00", "2026-11-23T06:30:00"),
            ("2026-11-22T06:29:59", "2026-11-22T06:30:00"),
            ("2026-11-22T06:30:00", "2026-11-23T06:30:00"),
            ("2026-10-24T20:00:00", "2026-10-25T06:30:00"),
        ] {
            assert_eq!(next_after(&at(now), morning), at(end));
        }
        let left = Deadline::next(morning).seconds_left();
        assert!(left > 0.0 && left <= 25.0 * 3600.0);
    }
}
