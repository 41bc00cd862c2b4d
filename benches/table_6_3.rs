//! Table 6.3 of Garland's thesis: complete decimation, and what goes with it.
//!
//! `cargo bench --bench table_6_3 -- --continue 28M` goes on with larger scans. The figures are printed, and written as JSON
//! and SVG below `target`. As a test everything is run once on small scans.

use meshmill::bench::{Table63, Table63Options, table_6_3};
use meshmill::budget::{MIB, Size};
use meshmill::job::{Count, cores};
use meshmill::progress::Progress;
use meshmill::report::{Mode, json};
use std::path::{Path, PathBuf};

/// Whether the results are to be asserted, and nothing timed.
fn only_tried(args: &[String]) -> bool {
    let said = |word: &str| args.iter().any(|arg| arg == word);
    said("--test") || !said("--bench")
}

/// The folder of the thesis's models in that of all models.
fn models() -> Option<PathBuf> {
    let folder = PathBuf::from(std::env::var_os("MESHMILL_MODELS")?);
    Some(Some(folder.join("table63")).filter(|inner| inner.is_dir()).unwrap_or(folder))
}

fn continued(args: &[String]) -> Vec<u64> {
    let sizes = args.iter().position(|arg| arg == "--continue").and_then(|at| args.get(at + 1));
    let size = |text: &str| text.parse::<Count>().unwrap_or_else(|error| panic!("--continue: {error}")).0;
    sizes.map_or(Vec::new(), |sizes| sizes.split(',').map(size).collect())
}

fn check(table: &Table63, tried: bool) {
    assert_eq!(table.models.len(), 12);
    for row in &table.models {
        assert!(row.complete.iter().all(|seconds| seconds.faces == 0 && seconds.total() > 0.0), "{row:?}");
    }
    let curves = table.models.iter().map(|row| &row.curve).chain(table.policies.iter().map(|policy| &policy.curve));
    assert!(curves.clone().all(|curve| curve.len() >= 5 && curve.iter().all(|point| point.initialisation > 0.0)));
    assert_eq!(table.policies.len(), 5);
    assert!(table.floor.one_thread > 0.0 && table.bytes_a_vertex > 0.0);
    let [_, large] = &table.continued[..] else { return assert!(!tried) };
    assert!(!tried || large.mode == Mode::OutOfCore && large.faces == 300_000 && large.target == 1000, "{large:?}");
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let tried = only_tried(&args);
    let scratch = tempfile::tempdir().unwrap();
    let options = Table63Options {
        models: models().filter(|_| !tried),
        continued: if tried { vec![20_000, 300_000] } else { continued(&args) },
        program: env!("CARGO_BIN_EXE_meshmill").into(),
        memory: Size(if tried { 24 * MIB } else { 1024 * MIB }),
        threads: if tried { 2 } else { cores() },
        runs: if tried { 1 } else { 3 },
        scratch: scratch.path().into(),
        most_faces: if tried { 4000 } else { u64::MAX },
    };
    let table = table_6_3(&options, &Progress::default()).unwrap_or_else(|error| panic!("{error}"));
    check(&table, tried);
    if tried {
        return;
    }
    println!("{}", table.lines().join("\n"));
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().unwrap_or(Path::new("target"));
    for (name, text) in [("table-6.3.json", json(&table)), ("table-6.3.svg", table.svg())] {
        let path = folder.join(name);
        std::fs::write(&path, text).unwrap();
        println!("written {}", path.display());
    }
}
