//! Memory for what is looked up all over, in huge pages.
//!
//! Binned vertices of 28 million faces are 27,000 ordinary pages, and a processor knows where one or two thousand are: a
//! look anywhere waits for the page's place, then for the vertex. In pages of 2 MiB there are 53. Where vertices are
//! shuffled, clustering takes 8 to 15 % less time for it. Memory that is looked up in a sensible order is better off
//! without: the system makes it contiguous while it is touched first, and nothing pays for that (4 ns a face of 45).

use bytemuck::{AnyBitPattern, NoUninit};
use memmap2::{MmapMut, MmapOptions};
use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};

/// Some numbers, zero at first.
pub(super) struct Pages<T> {
    map: MmapMut,
    of: PhantomData<T>,
}

impl<T: AnyBitPattern + NoUninit> Pages<T> {
    /// So many, looked up in a sensible order or in none. Fails if there is no memory.
    pub(super) fn zeroed(count: usize, coherent: bool) -> std::io::Result<Self> {
        let bytes = count.checked_mul(size_of::<T>()).ok_or(std::io::ErrorKind::OutOfMemory)?;
        let map = MmapOptions::new().len(bytes).map_anon()?;
        if !coherent {
            wish_for_huge(&map);
        }
        Ok(Pages { map, of: PhantomData })
    }
}

/// A system that knows of no huge pages has none to give.
#[cfg(target_os = "linux")]
fn wish_for_huge(map: &MmapMut) {
    _ = map.advise(memmap2::Advice::HugePage);
}

#[cfg(not(target_os = "linux"))]
fn wish_for_huge(_: &MmapMut) {}

impl<T: AnyBitPattern + NoUninit> Deref for Pages<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        bytemuck::cast_slice(&self.map)
    }
}

impl<T: AnyBitPattern + NoUninit> DerefMut for Pages<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        bytemuck::cast_slice_mut(&mut self.map)
    }
}
