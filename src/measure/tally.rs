//! What distances add up to, whoever measured them in whatever order.

/// An exact sum of doubles that are not negative: mantissas are added as integers, exponent by exponent. So the order of
/// adding cannot matter, and threads cannot change a bit. 32 KiB, of which a sum of similar numbers touches a few lines.
#[derive(Debug, Clone)]
pub(super) struct Sum(Box<[u128; EXPONENTS]>);

const EXPONENTS: usize = 1 << 11;
const MANTISSA_BITS: u32 = 52;

impl Default for Sum {
    fn default() -> Self {
        Sum(bytemuck::zeroed_box())
    }
}

impl Sum {
    /// Adds a number that is not negative.
    #[inline(always)]
    pub(super) fn add(&mut self, x: f64) {
        let exponent = (x.to_bits() >> MANTISSA_BITS) as usize & (EXPONENTS - 1);
        let mantissa = x.to_bits() & ((1 << MANTISSA_BITS) - 1);
        self.0[exponent] += u128::from(mantissa | u64::from(exponent > 0) << MANTISSA_BITS);
    }

    /// Adds another sum.
    pub(super) fn merge(&mut self, other: &Sum) {
        self.0.iter_mut().zip(other.0.iter()).for_each(|(to, from)| *to += from);
    }

    /// The sum, rounded a few times.
    pub(super) fn value(&self) -> f64 {
        let scaled =
            |(exponent, mantissas): (usize, &u128)| times_power(*mantissas as f64, exponent.max(1) as i32 - 1075);
        // From the least up, so that what is small is not lost to what is large.
        self.0.iter().enumerate().filter(|(_, m)| **m > 0).map(scaled).sum()
    }
}

/// `x · 2^e` in two steps, neither of which leaves the range of doubles before the result does.
fn times_power(x: f64, e: i32) -> f64 {
    let half = e / 2;
    x * 2f64.powi(half) * 2f64.powi(e - half)
}

/// Distances from samples of one mesh to the other.
#[derive(Debug, Clone, Default)]
pub(super) struct Tally {
    /// Of samples spread over the area: how many, the sum of their distances and that of the squares.
    pub(super) area: Moments,
    /// Of vertices.
    pub(super) vertices: Moments,
    /// The largest squared distance of all, and where; among equals the least place.
    pub(super) farthest: Option<Farthest>,
    /// A squared distance up to this is what rounding makes of none.
    pub(super) nothing_sq: f64,
}

/// Bytes of a tally.
pub(super) const BYTES: usize = 4 * EXPONENTS * size_of::<u128>();

/// A count, a sum and a sum of squares.
#[derive(Debug, Clone, Default)]
pub(super) struct Moments {
    pub(super) count: u64,
    pub(super) lengths: Sum,
    pub(super) squares: Sum,
}

/// A sample and its squared distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Farthest {
    pub(super) distance_sq: f64,
    pub(super) at: [f64; 3],
}

impl Moments {
    fn add(&mut self, square: f64) {
        self.count += 1;
        self.lengths.add(square.sqrt());
        self.squares.add(square);
    }

    fn merge(&mut self, other: &Moments) {
        self.count += other.count;
        self.lengths.merge(&other.lengths);
        self.squares.merge(&other.squares);
    }
}

impl Farthest {
    fn beats(&self, other: &Farthest) -> bool {
        let places = || other.at.iter().zip(&self.at).find_map(|(a, b)| Some(a.total_cmp(b)).filter(|o| o.is_ne()));
        let sizes = self.distance_sq.total_cmp(&other.distance_sq);
        sizes.is_gt() || sizes.is_eq() && places().is_some_and(|order| order.is_gt())
    }
}

impl Tally {
    /// A tally for which squared distances up to `nothing_sq` are none.
    pub(super) fn new(nothing_sq: f64) -> Self {
        Tally { nothing_sq, ..Tally::default() }
    }

    /// Counts a sample of the area, or a vertex.
    pub(super) fn add(&mut self, is_vertex: bool, at: [f64; 3], distance_sq: f64) {
        let distance_sq = self.settle(distance_sq);
        if is_vertex {
            self.vertices.add(distance_sq)
        } else {
            self.area.add(distance_sq)
        }
        self.see(Farthest { distance_sq, at });
    }

    /// A squared distance, without what only rounding made of it.
    pub(super) fn settle(&self, distance_sq: f64) -> f64 {
        if distance_sq > self.nothing_sq { distance_sq } else { 0.0 }
    }

    fn see(&mut self, new: Farthest) {
        if self.farthest.as_ref().is_none_or(|old| new.beats(old)) {
            self.farthest = Some(new);
        }
    }

    /// Adds another tally.
    pub(super) fn merge(&mut self, other: &Tally) {
        self.area.merge(&other.area);
        self.vertices.merge(&other.vertices);
        if let Some(farthest) = other.farthest {
            self.see(farthest);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_are_exact_in_any_order() {
        let numbers = [1e300, 1e-300, 0.1, 3.0, 5e-324, 0.0, 1e16, 1.0, 0.2];
        let mut forth = Sum::default();
        numbers.iter().for_each(|x| forth.add(*x));
        let (mut back, mut rest) = (Sum::default(), Sum::default());
        numbers[4..].iter().rev().for_each(|x| back.add(*x));
        numbers[..4].iter().rev().for_each(|x| rest.add(*x));
        back.merge(&rest);
        assert_eq!(forth.value(), back.value());
        assert_eq!(forth.value(), 1e300);

        let mut tenths = Sum::default();
        (0..10_000_000).for_each(|_| tenths.add(0.1));
        assert_eq!(tenths.value(), 1e6);
        let mut least = Sum::default();
        (0..3).for_each(|_| least.add(5e-324));
        assert_eq!(least.value(), 1.5e-323);
        assert_eq!(Sum::default().value(), 0.0);
    }

    #[test]
    fn the_farthest_is_the_same_whoever_saw_it_first() {
        let samples = [([1.0, 2.0, 3.0], 4.0), ([1.0, 1.0, 9.0], 4.0), ([0.0; 3], 1.0), ([5.0; 3], 1e-40)];
        let tally = |order: &[usize]| {
            let mut tally = Tally::new(1e-30);
            order.iter().for_each(|i| tally.add(i % 2 == 1, samples[*i].0, samples[*i].1));
            tally
        };
        for order in [[0, 1, 2, 3], [3, 2, 1, 0], [1, 0, 3, 2]] {
            let tally = tally(&order);
            assert_eq!(tally.farthest, Some(Farthest { distance_sq: 4.0, at: [1.0, 1.0, 9.0] }));
            assert_eq!((tally.area.count, tally.area.squares.value(), tally.area.lengths.value()), (2, 5.0, 3.0));
            assert_eq!((tally.vertices.count, tally.vertices.squares.value()), (2, 4.0));
        }
        let mut merged = tally(&[0]);
        merged.merge(&tally(&[1]));
        assert_eq!(merged.farthest, tally(&[1, 0]).farthest);
    }
}
