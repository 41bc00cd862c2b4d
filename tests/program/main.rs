//! The whole program, as its users run it: what it promises of results, memory and bytes, and what it does with bad input.

mod bad_input;
mod bench;
mod borders;
mod carry;
mod compare;
mod counts;
mod determinism;
mod faults;
mod formats;
mod inspect;
mod interrupt;
mod job;
mod materials;
mod memory;
mod models;
mod night;
mod oddities;
mod oracles;
mod precision;
mod render;
mod seams;
mod support;
mod thesis;
mod tiled;
mod uneven;
mod votes;

/// A budget in which scans of 100,000 faces and more go out of core.
const TIGHT: &str = "24MiB";
