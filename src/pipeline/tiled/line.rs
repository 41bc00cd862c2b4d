//! Tiles one behind the other: while all workers are at one, one of them puts away the tile before and brings the next.
//!
//! Most of what it takes to bring a tile, or to put it away, is one worker's: with two workers 1.6 of them were busy when
//! tiles took turns, and 1.8 are so. What three tiles take must fit; where it does not, they still take turns.

use crate::error::Result;

/// What memory holds of them.
pub(super) struct Line {
    /// Bytes that tiles may take.
    pub bytes: u64,
    /// Bytes that one takes for each of its faces, and for each that it has once it was worked on.
    pub face_bytes: u64,
    pub done_face_bytes: u64,
}

/// Where a tile is, and how many faces it has.
pub(super) struct Waiting<P> {
    pub faces: u64,
    pub place: P,
}

/// A tile that was worked on.
pub(super) trait Done: Send {
    /// How many faces it has now.
    fn faces(&self) -> u64;
}

impl Line {
    /// Brings every tile, works on it, and puts it away; all in order. Ends at the first that fails.
    pub fn run<P: Sync, T: Send, D: Done>(
        &self,
        tiles: &[Waiting<P>],
        bring: impl Fn(&P) -> Result<T> + Sync,
        work: impl Fn(T) -> Result<D> + Sync,
        mut put: impl FnMut(D) -> Result<()> + Send,
    ) -> Result<()> {
        let (mut done, mut brought) = (None::<D>, None::<T>);
        for (i, tile) in tiles.iter().enumerate() {
            let next = tiles.get(i + 1);
            let fits = self.holds(done.as_ref(), tile.faces + next.map_or(0, |next| next.faces));
            let next = next.filter(|_| fits);
            if !fits || brought.is_none() {
                done.take().map_or(Ok(()), &mut put)?;
            }
            let here = brought.take().map_or_else(|| bring(&tile.place), Ok)?;
            let before = done.take();
            let others = || {
                before.map_or(Ok(()), &mut put)?;
                next.map(|next| bring(&next.place)).transpose()
            };
            let (worked, others) = rayon::join(|| work(here), others);
            (done, brought) = (Some(worked?), others?);
        }
        done.map_or(Ok(()), put)
    }

    /// Whether there is room for tiles of so many faces beside one that was worked on.
    fn holds<D: Done>(&self, done: Option<&D>, faces: u64) -> bool {
        let of_done = done.map_or(0, |done| done.faces().saturating_mul(self.done_face_bytes));
        faces.saturating_mul(self.face_bytes).saturating_add(of_done) <= self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;
    use std::sync::atomic::{AtomicU64, Ordering::SeqCst};
    use std::sync::{Arc, Mutex};

    /// Faces of a tile in memory, beside all that are.
    struct InMemory(u64, Arc<AtomicU64>);

    impl InMemory {
        fn new(faces: u64, all: &Arc<AtomicU64>, most: &AtomicU64) -> Self {
            most.fetch_max(all.fetch_add(faces, SeqCst) + faces, SeqCst);
            InMemory(faces, all.clone())
        }

        fn halved(mut self) -> Self {
            self.1.fetch_sub(self.0 - self.0 / 2, SeqCst);
            self.0 /= 2;
            self
        }
    }

    impl Drop for InMemory {
        fn drop(&mut self) {
            self.1.fetch_sub(self.0, SeqCst);
        }
    }

    impl Done for InMemory {
        fn faces(&self) -> u64 {
            self.0
        }
    }

    #[test]
    fn tiles_are_put_away_in_order_and_no_more_are_in_memory_than_fit() {
        let faces = [50, 10, 20, 60, 90, 30, 30, 100, 5, 5, 5, 70];
        let tiles: Vec<_> = faces.iter().zip(0..).map(|(faces, place)| Waiting { faces: *faces, place }).collect();
        for bytes in [1000, 1200, 10_000] {
            let (all, most, order) = (Arc::<AtomicU64>::default(), AtomicU64::new(0), Mutex::new(Vec::new()));
            let bring = |place: &usize| Ok((*place, InMemory::new(faces[*place], &all, &most)));
            let work = |(place, tile): (usize, InMemory)| {
                order.lock().unwrap().push(place);
                Ok(tile.halved())
            };
            let mut away = Vec::new();
            let put = |tile: InMemory| {
                away.push(tile.0);
                Ok(())
            };
            Line { bytes, face_bytes: 10, done_face_bytes: 10 }.run(&tiles, bring, work, put).unwrap();
            assert_eq!(away, faces.map(|faces| faces / 2));
            assert!(order.into_inner().unwrap().into_iter().eq(0..faces.len()));
            let most = most.into_inner();
            assert!(10 * most <= bytes && (bytes < 10_000 || most > 100), "{most} of {bytes}");
            assert_eq!(all.load(SeqCst), 0);
        }
    }

    #[test]
    fn the_first_error_ends_it() {
        let tiles: Vec<_> = (0..9u64).map(|place| Waiting { faces: 1, place }).collect();
        let error = |what: u64| Error::usage(what.to_string());
        for failing in 0..3 {
            let fails = |at: u64, place: u64| if failing == at && place == 5 { Err(error(at)) } else { Ok(()) };
            let (all, most, mut away) = (Arc::<AtomicU64>::default(), AtomicU64::new(0), 0);
            let bring = |place: &u64| fails(0, *place).map(|()| (*place, InMemory::new(*place, &all, &most)));
            let work = |(place, tile): (u64, InMemory)| fails(1, place).map(|()| tile);
            let put = |tile: InMemory| {
                away += 1;
                fails(2, tile.0)
            };
            let line = Line { bytes: 100, face_bytes: 1, done_face_bytes: 1 };
            assert_eq!(line.run(&tiles, bring, work, put).unwrap_err().to_string(), failing.to_string());
            assert!((4..=6).contains(&away), "{away}");
        }
    }
}
