//! Memory: how sizes are written, and (from them) every chunk, table and batch size of a run.

use std::fmt;
use std::str::FromStr;

/// One mebibyte.
pub const MIB: u64 = 1 << 20;

/// A number of bytes, written `512MiB`, `1.5GiB`, `200MB` or plain `536870912`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Size(pub u64);

impl fmt::Display for Size {
    /// Whole mebibytes, rounded up, so that a size that is named as sufficient is.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}MiB", self.0.div_ceil(MIB))
    }
}

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        let split = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
        let (number, unit) = (text[..split].trim(), text[split..].trim());
        let factor: f64 = match unit.to_ascii_lowercase().as_str() {
            "" | "b" => 1.0,
            "k" | "kib" => 1024.0,
            "m" | "mib" => MIB as f64,
            "g" | "gib" => 1024.0 * MIB as f64,
            "t" | "tib" => 1024.0 * 1024.0 * MIB as f64,
            "kb" => 1e3,
            "mb" => 1e6,
            "gb" => 1e9,
            "tb" => 1e12,
            _ => return Err(format!("`{text}` is not a size: write it like 512MiB, 2GiB or 800MB")),
        };
        let number: f64 = number.parse().map_err(|_| format!("`{text}` is not a size: write it like 512MiB"))?;
        let bytes = number * factor;
        if !(1.0..9.0e18).contains(&bytes) {
            return Err(format!("`{text}` is not a size that a machine can have"));
        }
        Ok(Size(bytes as u64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_read_as_people_write_them() {
        for (text, bytes) in
            [("512MiB", 512 << 20), ("2g", 2 << 30), ("800MB", 800_000_000), ("1.5 KiB", 1536), ("77", 77)]
        {
            assert_eq!(text.parse(), Ok(Size(bytes)), "{text}");
        }
        for text in ["", "MiB", "-1MiB", "0", "12 parsecs", "nan", "1e30GiB"] {
            assert!(text.parse::<Size>().is_err(), "{text}");
        }
        assert_eq!(Size((256 << 20) + 1).to_string(), "257MiB");
    }
}
