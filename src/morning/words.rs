//! Numbers as people read them at a glance.

/// A space that does not end a line.
const NARROW: char = '\u{a0}';

/// `28.1 M`, `140 k`, `999`.
pub(super) fn short_count(n: u64) -> String {
    let (value, unit) = match n {
        0..10_000 => return n.to_string(),
        10_000..1_000_000 => (n as f64 / 1e3, "k"),
        1_000_000..1_000_000_000 => (n as f64 / 1e6, "M"),
        _ => (n as f64 / 1e9, "G"),
    };
    format!("{}{NARROW}{unit}", three_digits(value))
}

/// `524 MB`, `1.93 GB`: as disks are sold.
pub(super) fn disk(bytes: u64) -> String {
    let (value, unit) = match bytes {
        0..1000 => return format!("{bytes}{NARROW}B"),
        1000..1_000_000 => (bytes as f64 / 1e3, "kB"),
        1_000_000..1_000_000_000 => (bytes as f64 / 1e6, "MB"),
        1_000_000_000..1_000_000_000_000 => (bytes as f64 / 1e9, "GB"),
        _ => (bytes as f64 / 1e12, "TB"),
    };
    format!("{}{NARROW}{unit}", three_digits(value))
}

/// `188 MiB`: as budgets are given.
pub(super) fn memory(bytes: u64) -> String {
    let mib = bytes as f64 / (1u64 << 20) as f64;
    if mib < 10_000.0 { format!("{mib:.0}{NARROW}MiB") } else { format!("{}{NARROW}GiB", three_digits(mib / 1024.0)) }
}

/// `0.8 s`, `42 s`, `3 min 20 s`, `2 h 05 min`.
pub(super) fn span(seconds: f64) -> String {
    let whole = seconds.max(0.0).round() as u64;
    match whole {
        0..10 => format!("{seconds:.1} s"),
        10..100 => format!("{whole} s"),
        100..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
    }
}

/// `0.0123`, `12.3`, `1.23e-6`.
pub(super) fn length(x: f64) -> String {
    match x.abs() {
        0.0 => "0".into(),
        a if (1e-4..1e5).contains(&a) => {
            let decimals = (2 - a.log10().floor() as i32).max(0) as usize;
            format!("{x:.decimals$}")
        }
        _ => format!("{x:.2e}"),
    }
}

fn three_digits(x: f64) -> String {
    match x {
        x if x < 9.995 => format!("{x:.2}"),
        x if x < 99.95 => format!("{x:.1}"),
        x => format!("{x:.0}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let plain = |text: String| text.replace(NARROW, " ");
        assert_eq!([999, 9999, 140_000, 28_061_000].map(short_count).map(plain), ["999", "9999", "140 k", "28.1 M"]);
        assert_eq!([999, 524_000, 1_925_932_720].map(disk).map(plain), ["999 B", "524 kB", "1.93 GB"]);
        assert_eq!(plain(memory(188 << 20)), "188 MiB");
        assert_eq!([0.84, 42.4, 200.0, 7500.0].map(span), ["0.8 s", "42 s", "3 min 20 s", "2 h 05 min"]);
        assert_eq!([0.0, 0.012345, 12.345, 98765.4, 1e-9].map(length), ["0", "0.0123", "12.3", "98765", "1.00e-9"]);
    }
}
