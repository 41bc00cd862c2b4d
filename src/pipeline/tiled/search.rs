//! The strength at which what is left is what is wanted.

/// Of a cost, the power of the area that a face stands for that it goes with: 3 on a smooth surface, 1 where noise
/// decides. Where nothing is known yet.
const COST_POWER: f64 = 3.0;
/// What such a power may turn out to be.
const POWERS: (f64, f64) = (0.5, 4.0);
/// How many times as strong, or as weak, the next trial may be.
const MOST_STEP: f64 = 1e6;
/// The share of what is between two trials that the next one keeps from either.
const INSET: f64 = 0.05;

/// A trial, both numbers as logarithms: how strong it was, and how many times as much as is wanted it left.
type Trial = (f64, f64);

/// Looks for a strength that leaves one time of what is wanted, where more of it leaves less. It goes along a line
/// through the two nearest trials in logarithms, since what is left goes with a power of the strength.
#[derive(Debug, Clone)]
pub(super) struct Search {
    too_weak: Option<Trial>,
    too_strong: Option<Trial>,
    last: Option<Trial>,
    power: f64,
    /// How much further down to go than the power says, while all trials are too strong: twice as far each time, or what
    /// a strength hardly changes would keep it there.
    stretch: f64,
}

impl Search {
    /// Among costs, of which none was tried.
    pub fn of_cost() -> Self {
        Search { too_weak: None, too_strong: None, last: None, power: COST_POWER, stretch: 1.0 }
    }

    /// Among floors: what is left goes with one over the strength.
    pub fn of_floor() -> Self {
        Search { power: 1.0, ..Self::of_cost() }
    }

    /// Another search of the same, which knows the power that this one has found.
    pub fn anew(&self) -> Self {
        Search { power: self.power, ..Self::of_cost() }
    }

    /// A trial has left so many times as much as is wanted.
    pub fn tried(&mut self, strength: f64, times: f64) {
        let trial = (strength.ln(), times.max(f64::MIN_POSITIVE).ln());
        if let Some(last) = self.last {
            let power = (trial.0 - last.0) / (last.1 - trial.1);
            if power.is_finite() && power > 0.0 {
                self.power = power.clamp(POWERS.0, POWERS.1);
            }
        }
        let is_weak = |(_, times): Trial| times > 0.0;
        let (side, other) = match is_weak(trial) {
            true => (&mut self.too_weak, &mut self.too_strong),
            false => (&mut self.too_strong, &mut self.too_weak),
        };
        *side = Some(trial);
        if self.last.is_some_and(|last| is_weak(last) == is_weak(trial)) {
            match other {
                // Two on one side: what is on the other counts half (the Illinois method), or it would never be left.
                Some(other) => other.1 *= 0.5,
                // Stronger than it has to be is not to be undone: that way steps stay short.
                None if is_weak(trial) => {}
                None => self.stretch *= 2.0,
            }
        }
        self.last = Some(trial);
    }

    /// The next one to try, after the first.
    pub fn next(&self) -> f64 {
        let next = match (self.too_weak, self.too_strong) {
            (Some(weak), Some(strong)) => {
                let part = (weak.1 / (weak.1 - strong.1)).clamp(INSET, 1.0 - INSET);
                weak.0 + part * (strong.0 - weak.0)
            }
            (Some(one), None) | (None, Some(one)) => {
                one.0 + (self.stretch * self.power * one.1).clamp(-MOST_STEP.ln(), MOST_STEP.ln())
            }
            (None, None) => 0.0,
        };
        next.exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How many trials it takes to come within 3 %, from a first that is so many times too strong.
    fn trials(mut search: Search, first: f64, left: impl Fn(f64) -> f64) -> usize {
        let mut strength = first;
        for trial in 1..100 {
            let times = left(strength);
            if (times - 1.0).abs() < 0.03 {
                return trial;
            }
            search.tried(strength, times);
            strength = search.next();
        }
        panic!("not found");
    }

    #[test]
    fn any_power_is_found_in_a_few_trials() {
        for power in [0.5, 1.0, 1.6, 3.0, 4.0] {
            for first in [1e-3, 0.1, 1.0, 20.0, 1e4] {
                let left = |strength: f64| strength.powf(-1.0 / power);
                assert!(trials(Search::of_cost(), first, left) <= 4, "{power} {first}");
                assert!(trials(Search::of_floor(), first, left) <= 4, "{power} {first}");
            }
        }
    }

    #[test]
    fn what_is_no_power_is_found_as_well() {
        // Two powers, one behind the other; what never goes; and steps, as a small mesh has.
        let bent = |strength: f64| strength.powf(if strength < 2.0 { -1.0 } else { -0.3 }) * 1.2;
        let stays = |strength: f64| 0.6 + 0.8 / (1.0 + strength);
        let steps = |strength: f64| (50.0 * strength.powf(-0.4)).round() / 50.0;
        for first in [1e-2, 1.0, 1e3] {
            assert!(trials(Search::of_cost(), first, bent) <= 8);
            assert!(trials(Search::of_cost(), first, stays) <= 12);
            assert!(trials(Search::of_cost(), first, steps) <= 6);
        }
    }

    #[test]
    fn where_no_strength_leaves_enough_it_soon_is_none() {
        for times in [0.05, 0.5, 0.9, 0.96] {
            let mut search = Search::of_cost();
            let mut strength: f64 = 1e-14;
            let trials = (1..100).find(|_| {
                search.tried(strength, times);
                strength = search.next();
                strength < f64::from(f32::MIN_POSITIVE)
            });
            assert!(trials.is_some_and(|trials| trials < 12), "{times}: {trials:?}");
        }
    }

    #[test]
    fn what_was_learnt_of_the_power_is_kept() {
        let mut search = Search::of_cost();
        search.tried(1.0, 4.0);
        search.tried(16.0, 0.25);
        let mut again = search.anew();
        again.tried(1.0, 1.5);
        assert!((again.next() - 1.5).abs() < 1e-9);
    }
}
