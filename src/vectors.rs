//! How hot loops get the vectors that the processor has.
//!
//! `dispatch!` compiles its body once for each width and runs the widest that the processor has. The body is a function
//! that is `#[inline(always)]`, takes the token of its width, and works on the vectors of `fearless_simd`, or in plain
//! short loops over arrays, which then become as wide. What is worked out is the same by all widths: no operation is
//! fused, none is an estimate, and sums go in an order of their own.
//!
//! Vectors are not worked on within closures that are handed to `array::map` or `from_fn`: where those are not inlined,
//! every single operation becomes a call (the collapse took a third longer so).

use fearless_simd::{Simd, f32x4, prelude::*};

/// Rows as columns.
#[inline(always)]
pub fn transposed<V: Simd>([a, b, c, d]: [f32x4<V>; 4]) -> [f32x4<V>; 4] {
    let ((ac_low, ac_high), (bd_low, bd_high)) = (a.interleave(c), b.interleave(d));
    let ((first, second), (third, fourth)) = (ac_low.interleave(bd_low), ac_high.interleave(bd_high));
    [first, second, third, fourth]
}

/// The widths of vectors that tests can try here, the narrowest first.
#[cfg(test)]
pub fn levels() -> Vec<fearless_simd::Level> {
    use fearless_simd::Level;
    let here = Level::new();
    #[cfg(target_arch = "x86_64")]
    let narrower = [here.as_sse4_2().map(Simd::level), here.as_avx2().map(Simd::level)];
    #[cfg(not(target_arch = "x86_64"))]
    let narrower = [None; 2];
    [Some(Level::baseline())].into_iter().chain(narrower).flatten().chain([here]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use fearless_simd::dispatch;

    #[test]
    fn rows_become_columns() {
        let rows: [[f32; 4]; 4] = std::array::from_fn(|i| std::array::from_fn(|j| (10 * i + j) as f32));
        for level in levels() {
            let columns = dispatch!(level, simd => {
                transposed(rows.map(|row| f32x4::load_array(simd, row))).map(|column| column.to_array())
            });
            assert!((0..16).all(|k| columns[k % 4][k / 4] == rows[k / 4][k % 4]), "{columns:?}");
        }
    }
}
