//! Quantities as people write them: one `FromStr` each, which serves the command line and job files alike.

use serde::{Deserializer, Serialize, Serializer, de};
use std::fmt;
use std::marker::PhantomData;
use std::str::FromStr;

use crate::budget::{MIB, Size};
use crate::collapse::{Least, PairDistance};

/// A number of faces: `500k`, `2.5M`, `1G`, `140000` or `1_000`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct Count(pub u64);

/// A share above 0 and up to 1: `0.1` or `10%`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Ratio(pub f64);

/// A positive length in the scan's units: `0.05` or `1e-3`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Length(pub f64);

/// A number of threads, 1 to [`Threads::MOST`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct Threads(pub usize);

/// A number of rounds, 0 to [`Rounds::MOST`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct Rounds(pub u32);

/// A factor of zero or more.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Weight(pub f64);

impl FromStr for Count {
    type Err = String;

    /// Exact: the decimal point is moved, never multiplied through a float.
    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        if text.ends_with('%') {
            return Err(format!("`{text}` is a ratio, not a count of faces"));
        }
        let (number, zeros) = match text.char_indices().last() {
            Some((at, 'k' | 'K')) => (&text[..at], 3),
            Some((at, 'm' | 'M')) => (&text[..at], 6),
            Some((at, 'g' | 'G')) => (&text[..at], 9),
            _ => (text, 0),
        };
        let (whole, part) = number.trim_end().split_once('.').unwrap_or((number.trim_end(), ""));
        let part = part.trim_end_matches('0');
        let grouped = |b: u8| b.is_ascii_digit() || b == b'_';
        if !whole.starts_with(|c: char| c.is_ascii_digit())
            || !whole.bytes().all(grouped)
            || !part.bytes().all(|b| b.is_ascii_digit())
        {
            return Err(format!("`{text}` is not a count: write it like 140000, 500k or 2.5M"));
        }
        if part.len() > zeros {
            return Err(format!("`{text}` is not a whole number of faces"));
        }
        let shifted = format!("{whole}{part:0<zeros$}").replace('_', "");
        match shifted.parse() {
            Ok(n) if n <= i64::MAX as u64 => Ok(Count(n)),
            _ => Err(format!("`{text}` is more faces than a file can have")),
        }
    }
}

impl FromStr for Ratio {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        let ratio = match text.strip_suffix('%') {
            Some(percent) => number(&format!("{}e-2", percent.trim_end())),
            None => number(text),
        };
        match ratio {
            Some(r) if r > 0.0 && r <= 1.0 => Ok(Ratio(r)),
            Some(_) => Err(format!("`{text}` is not a ratio above 0 and up to 1 (100%)")),
            None => Err(format!("`{text}` is not a ratio: write it like 0.1 or 10%")),
        }
    }
}

impl FromStr for Length {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match number(text.trim()) {
            Some(x) if x > 0.0 => Ok(Length(x)),
            Some(_) => Err(format!("`{text}` is not a length above 0")),
            None => Err(format!("`{text}` is not a length: write it in the scan's units, like 0.05")),
        }
    }
}

impl Threads {
    /// More threads than any machine has cores is a slip of the keyboard, not a wish.
    pub const MOST: usize = 1024;
}

impl FromStr for Threads {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.trim().parse() {
            Ok(n) if (1..=Self::MOST).contains(&n) => Ok(Threads(n)),
            _ => Err(format!("`{text}` is not a number of threads from 1 to {}", Self::MOST)),
        }
    }
}

impl Rounds {
    /// After some ten rounds nothing moves any more.
    pub const MOST: u32 = 100;
}

impl FromStr for Rounds {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.trim().parse() {
            Ok(n) if n <= Self::MOST => Ok(Rounds(n)),
            _ => Err(format!("`{text}` is not a number of rounds from 0 to {}", Self::MOST)),
        }
    }
}

impl FromStr for Weight {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match number(text.trim()) {
            Some(x) if x >= 0.0 => Ok(Weight(x)),
            _ => Err(format!("`{text}` is not a weight of 0 or more")),
        }
    }
}

/// An angle in degrees, above 0 and below 180.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Degrees(pub f64);

impl FromStr for Degrees {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match number(text.trim()) {
            Some(x) if x > 0.0 && x < 180.0 => Ok(Degrees(x)),
            _ => Err(format!("`{text}` is not an angle above 0 and below 180 degrees")),
        }
    }
}

/// A compactness, from 0 (a line) to 1 (an equilateral triangle).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Compactness(pub f64);

impl FromStr for Compactness {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match number(text.trim()) {
            Some(x) if (0.0..=1.0).contains(&x) => Ok(Compactness(x)),
            _ => Err(format!("`{text}` is not a compactness from 0 to 1")),
        }
    }
}

/// The least that a piece may be: so many faces, `100`, or `area=0.5` in the scan's units, squared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MinComponent(pub Least);

impl FromStr for MinComponent {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.trim().strip_prefix("area=").map(|area| number(area.trim())) {
            None => text.parse().map(|Count(n)| MinComponent(Least::Faces(n))),
            Some(Some(area)) if area > 0.0 => Ok(MinComponent(Least::Area(area))),
            Some(_) => Err(format!("`{text}` is not an area above 0: write it like area=0.5")),
        }
    }
}

impl Serialize for MinComponent {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            Least::Faces(n) => out.serialize_u64(n),
            Least::Area(area) => out.collect_str(&format_args!("area={area}")),
        }
    }
}

/// How close vertices without an edge must be to merge: a length, or `auto`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pairs(pub PairDistance);

impl FromStr for Pairs {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.trim() {
            "auto" => Ok(Pairs(PairDistance::Auto)),
            text => text.parse().map(|Length(x)| Pairs(PairDistance::Within(x))),
        }
    }
}

impl Serialize for Pairs {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            PairDistance::Within(distance) => out.serialize_f64(distance),
            PairDistance::Auto => out.serialize_str("auto"),
        }
    }
}

/// A finite number: `inf` and `nan` are none.
fn number(text: &str) -> Option<f64> {
    text.parse().ok().filter(|x: &f64| x.is_finite())
}

/// For `deserialize_with`: text, or a bare number read as the text that a person would write.
pub(super) fn as_written<'de, D, T>(input: D) -> Result<Option<T>, D::Error>
where
    D: Deserializer<'de>,
    T: FromStr<Err = String>,
{
    input.deserialize_any(AsWritten(PhantomData)).map(Some)
}

struct AsWritten<T>(PhantomData<T>);

impl<T: FromStr<Err = String>> de::Visitor<'_> for AsWritten<T> {
    type Value = T;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a number, or a number with its unit in quotes")
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<T, E> {
        text.parse().map_err(E::custom)
    }

    fn visit_i64<E: de::Error>(self, n: i64) -> Result<T, E> {
        self.visit_str(&n.to_string())
    }

    fn visit_u64<E: de::Error>(self, n: u64) -> Result<T, E> {
        self.visit_str(&n.to_string())
    }

    fn visit_f64<E: de::Error>(self, x: f64) -> Result<T, E> {
        self.visit_str(&x.to_string())
    }
}

/// For `serialize_with`: a size that reads back as the same bytes.
pub(super) fn write_size<S: Serializer>(size: &Option<Size>, out: S) -> Result<S::Ok, S::Error> {
    match size {
        Some(size) if size.0.is_multiple_of(MIB) => out.collect_str(size),
        Some(size) => out.serialize_u64(size.0),
        None => out.serialize_none(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_exact() {
        for (text, n) in [
            ("140000", 140_000),
            ("500k", 500_000),
            ("500K", 500_000),
            ("2.5M", 2_500_000),
            ("1G", 1_000_000_000),
            ("1_000", 1000),
            ("0.001k", 1),
            ("7.0", 7),
            (" 12 k ", 12_000),
            ("0", 0),
            ("4294967306", 4_294_967_306),
        ] {
            assert_eq!(text.parse(), Ok(Count(n)), "{text}");
        }
        for text in ["", "k", "-5", "+5", ".5k", "_1", "1,000", "1e6", "ten", "10%", "nan", "0.1_0k"] {
            assert!(text.parse::<Count>().is_err(), "{text}");
        }
        for text in ["1.5", "0.0005k", "9.007199254740993M", "99999999999G", "9223372036854775808"] {
            assert!(text.parse::<Count>().is_err(), "{text}");
        }
        assert!("10%".parse::<Count>().unwrap_err().contains("ratio"));
    }

    #[test]
    fn ratios_read_as_shares_and_as_percent() {
        for (text, r) in [("0.1", 0.1), ("10%", 0.1), ("33.3 %", 0.333), ("29%", 0.29), ("1", 1.0), ("100%", 1.0)] {
            assert_eq!(text.parse(), Ok(Ratio(r)), "{text}");
        }
        for text in ["0", "0%", "1.01", "101%", "-0.5", "-5%", "nan", "inf", "%", "half", ""] {
            assert!(text.parse::<Ratio>().is_err(), "{text}");
        }
    }

    #[test]
    fn what_policies_take_keeps_its_bounds() {
        assert_eq!("1k".parse(), Ok(MinComponent(Least::Faces(1000))));
        assert_eq!("area=0.5".parse(), Ok(MinComponent(Least::Area(0.5))));
        for text in ["area=0", "area=-1", "area=x", "0.5", "area", ""] {
            assert!(text.parse::<MinComponent>().is_err(), "{text}");
        }
        for text in ["0", "180", "-5", "x"] {
            assert!(text.parse::<Degrees>().is_err(), "{text}");
        }
        assert_eq!("0.5".parse(), Ok(Compactness(0.5)));
        assert!("1.1".parse::<Compactness>().is_err() && "-0.1".parse::<Compactness>().is_err());
    }

    #[test]
    fn lengths_threads_and_weights_keep_their_bounds() {
        assert_eq!("0.05".parse(), Ok(Length(0.05)));
        assert_eq!("1e-12".parse(), Ok(Length(1e-12)));
        for text in ["0", "-1", "inf", "NaN", "1e400", "5mm", ""] {
            assert!(text.parse::<Length>().is_err(), "{text}");
        }
        assert_eq!("8".parse(), Ok(Threads(8)));
        for text in ["0", "-1", "1025", "2.5", "all", "18446744073709551617"] {
            assert!(text.parse::<Threads>().is_err(), "{text}");
        }
        assert_eq!("0".parse(), Ok(Weight(0.0)));
        assert!("-0.1".parse::<Weight>().is_err());
        assert!("inf".parse::<Weight>().is_err());
    }
}
