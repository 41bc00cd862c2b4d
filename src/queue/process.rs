//! What the system says of processes.

use crate::error::{Error, Result};
use std::path::{Path, PathBuf};

/// The file of the program that runs.
pub fn this_program() -> Result<PathBuf> {
    std::env::current_exe().map_err(Error::io(Path::new("/proc/self/exe"), "cannot be found"))
}

/// The resident set of a process now, mapped pages included; `None` where it is gone or the system does not say.
pub fn rss_bytes(process: u32) -> Option<u64> {
    status_bytes(&format!("/proc/{process}/status"), "VmRSS:")
}

/// The peak of this process's resident set since it began or [`reset_peak`].
pub(super) fn peak_bytes() -> Option<u64> {
    status_bytes("/proc/self/status", "VmHWM:")
}

/// Begins the count of the peak anew, where the system can.
pub fn reset_peak() {
    // Where it cannot, the peak is that of all tasks so far: an upper bound.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

fn status_bytes(path: &str, key: &str) -> Option<u64> {
    let status = std::fs::read_to_string(path).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim_end().parse().ok()?;
    kib.checked_mul(1024)
}

/// How often the kernel has killed a process for want of memory since the machine started.
pub(super) fn out_of_memory_kills() -> u64 {
    let counts = std::fs::read_to_string("/proc/vmstat").unwrap_or_default();
    let count = counts.lines().find_map(|line| line.strip_prefix("oom_kill "));
    count.and_then(|n| n.trim().parse().ok()).unwrap_or(0)
}

/// Memory that could be had now without swapping.
pub(super) fn available_bytes() -> Option<u64> {
    status_bytes("/proc/meminfo", "MemAvailable:")
}

/// Free space on the file system of a folder, for this user.
pub(super) fn free_bytes(folder: &std::path::Path) -> Option<u64> {
    let found = rustix::fs::statvfs(folder).ok()?;
    found.f_bavail.checked_mul(found.f_frsize)
}

/// The word for a signal that ends processes.
pub(super) fn signal_name(signal: i32) -> String {
    signal_hook::low_level::signal_name(signal).map_or_else(|| format!("signal {signal}"), String::from)
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn this_process_is_resident_and_its_peak_begins_anew() {
        let now = rss_bytes(std::process::id()).unwrap();
        assert!(now > 1 << 20 && peak_bytes().unwrap() > 1 << 20);
        assert!(rss_bytes(u32::MAX).is_none());
        assert!(available_bytes().unwrap() > 1 << 20 && free_bytes("/".as_ref()).is_some());
        assert_eq!((signal_name(7).as_str(), signal_name(9).as_str()), ("SIGBUS", "SIGKILL"));
    }
}
