//! What the system's allocator keeps of the memory that is given back to it.
//!
//! glibc gives arrays of up to 32 MiB back only until it has seen some of that size go; from then on it keeps them, in a
//! heap for each thread. Of 28 million faces in tiles within 100 MiB that was 30 to 40 MiB on top of what was in use, and no
//! stage can set aside what it cannot know. With bounds that stay, arrays go back when they are dropped. Bounds can only be
//! set when a program starts, and depend on the budget, so this one starts once more (1.5 ms).

#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod glibc {
    use std::ffi::OsString;
    use std::os::unix::process::CommandExt;
    use std::process::Command;

    /// Where glibc looks for its settings: names and values, with colons between them.
    const SETTINGS: &str = "GLIBC_TUNABLES";
    /// Set in the environment of a program that was started again. Where privileges have the system take the settings away, it
    /// would start for ever.
    const AGAIN: &str = "MESHMILL_STARTED_AGAIN";
    /// Bytes from which on arrays are mapped by themselves.
    const MAPPED: &str = "glibc.malloc.mmap_threshold";
    /// Bytes that may be free at the end of a heap.
    const FREE: &str = "glibc.malloc.trim_threshold";
    /// Arrays are mapped from this share of the budget on: a smaller one costs time where arrays come and go (4 to 9 % in core
    /// on two threads with 1 MiB or less), a larger one memory.
    const SHARE: u64 = 128;
    /// What glibc begins with, and where it ends.
    const LEAST: u64 = 128 << 10;
    const MOST: u64 = 32 << 20;
    /// So many times as much may be free, up to a bound. With as much, small tiles take up to 28 % longer, since each gives back
    /// what the next takes; with four times as much again they are no faster. With 32 MiB the collapse in core takes 10 %
    /// more memory, with 64 MiB 30 %, and is no faster.
    const TIMES_FREE: u64 = 4;
    const ENOUGH_FREE: u64 = 8 << 20;

    /// The settings with the bounds among them; `None` where whoever started the program has chosen some.
    pub fn with_bounds(settings: &str, budget_bytes: u64) -> Option<String> {
        if [MAPPED, FREE].iter().any(|name| settings.contains(name)) {
            return None;
        }
        let bytes = (budget_bytes / SHARE).clamp(LEAST, MOST);
        let given = settings.split(':').filter(|setting| !setting.is_empty()).map(String::from);
        let free = (TIMES_FREE * bytes).min(ENOUGH_FREE).max(bytes);
        let bounds = [(MAPPED, bytes), (FREE, free)].map(|(name, bytes)| format!("{name}={bytes}"));
        Some(given.chain(bounds).collect::<Vec<_>>().join(":"))
    }

    /// Starts the program again with the bounds set, in the same process. Returns where they are, or that cannot be.
    pub fn bound(budget_bytes: u64) {
        if std::env::var_os(AGAIN).is_some() {
            return;
        }
        let before = std::env::var_os(SETTINGS).unwrap_or_default();
        let Some(settings) = before.to_str().and_then(|settings| with_bounds(settings, budget_bytes)) else { return };
        let Ok(program) = std::env::current_exe() else { return };
        let mut args = std::env::args_os();
        let name = args.next().unwrap_or_else(|| OsString::from(&program));
        // Returns only if it fails.
        let _ = Command::new(program).arg0(name).args(args).env(SETTINGS, settings).env(AGAIN, "1").exec();
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn bounds_join_what_is_set_and_are_set_once() {
            let bounds = "glibc.malloc.mmap_threshold=4194304:glibc.malloc.trim_threshold=8388608";
            assert_eq!(with_bounds("", 512 << 20).as_deref(), Some(bounds));
            assert_eq!(with_bounds(bounds, 1 << 30), None);
            assert_eq!(with_bounds("glibc.malloc.trim_threshold=1", 1 << 30), None);
            let with_others = with_bounds("glibc.malloc.arena_max=2", 512 << 20).unwrap();
            assert_eq!(with_others, format!("glibc.malloc.arena_max=2:{bounds}"));
            assert!(with_bounds("", 1).unwrap().ends_with("mmap_threshold=131072:glibc.malloc.trim_threshold=524288"));
            assert!(
                with_bounds("", u64::MAX)
                    .unwrap()
                    .ends_with("mmap_threshold=33554432:glibc.malloc.trim_threshold=33554432")
            );
        }
    }
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub use glibc::bound;

/// Other allocators do as they do.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub fn bound(_budget_bytes: u64) {}
