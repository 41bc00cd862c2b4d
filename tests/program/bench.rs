//! `meshmill bench`: what it prints and writes. Times are not asserted.

use crate::support::{Folder, program};
use serde_json::Value;
use std::fs;

#[test]
fn table_6_3_is_printed_and_drawn() {
    let folder = Folder::new();
    let mut command = program();
    command.env_remove("MESHMILL_MODELS").args(["bench", "table-6.3", "--most-faces", "1000", "--runs", "1"]);
    command.args(["--continue", "2000,100k", "--memory", "23MiB", "--threads", "2", "--json", "--scratch"]);
    let output = command.arg(folder.path("")).arg("-o").arg(folder.path("")).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{stderr}");
    let object: Value = serde_json::from_slice(&output.stdout).unwrap();
    let models = object["models"].as_array().unwrap();
    assert_eq!(models.len(), 12);
    for row in models {
        let ends = [&row["complete"][0], &row["complete"][1], &row["curve"][6]].map(|end| &end["faces"]);
        assert!(row["faces"] == 1000 && row["file"].is_null() && ends.iter().all(|faces| **faces == 0), "{row}");
        assert_eq!((&row["curve"][0]["faces"], &row["complete"][1]["threads"]), (&750.into(), &2.into()));
    }
    assert_eq!(models[6]["thesis"]["faces"], 69_451);
    assert_eq!(object["policies"].as_array().unwrap().len(), 5);
    assert!((object["exponents"]["thesis"].as_f64().unwrap() - 1.1).abs() < 0.1, "{object}");
    let modes: Vec<_> = object["continued"].as_array().unwrap().iter().map(|row| &row["mode"]).collect();
    assert_eq!(modes, ["in-core", "out-of-core"]);
    // What was made is gone again.
    assert_eq!(folder.names(), ["table-6.3.json", "table-6.3.svg"]);
    let svg = fs::read_to_string(folder.path("table-6.3.svg")).unwrap();
    assert!(svg.starts_with("<svg ") && svg.matches("<polyline points").count() == 4, "{svg}");
    let kept: Value = serde_json::from_slice(&fs::read(folder.path("table-6.3.json")).unwrap()).unwrap();
    assert_eq!(kept, object);

    let refused = program().args(["bench", "table-6.3", "--runs", "0"]).output().unwrap();
    assert_eq!(refused.status.code(), Some(2));
}
