//! `meshmill render`: the same picture whatever the threads, the format and the order of faces, within its budget.

use crate::support::{Folder, Kind, Outcome, field, program, torus};
use std::path::{Path, PathBuf};

fn render(folder: &Folder, meshes: &[&Path], args: &[&str]) -> Outcome {
    let mut command = program();
    command.arg("render").args(meshes).arg("-o").arg(folder.path("out.png")).args(args).arg("--json");
    Outcome::of(command, PathBuf::new())
}

/// Width, height and pixels.
#[track_caller]
fn picture(folder: &Folder, meshes: &[&Path], args: &[&str]) -> (u32, u32, Vec<u8>) {
    let outcome = render(folder, meshes, args);
    assert_eq!(outcome.code, Some(0), "{}", outcome.stderr);
    let file = std::io::BufReader::new(std::fs::File::open(folder.path("out.png")).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
    let frame = reader.next_frame(&mut rgb).unwrap();
    assert_eq!((&outcome.object["width"], &outcome.object["height"]), (&frame.width.into(), &frame.height.into()));
    (frame.width, frame.height, rgb)
}

#[test]
fn a_picture_depends_on_what_is_seen_alone() {
    let folder = Folder::new();
    let mesh = torus(120, 60);
    let scan = folder.scan("a", &mesh, Kind::Floats);
    let args = ["--width", "200", "--height", "150", "--zoom", "4"];
    let first = picture(&folder, &[&scan], &args);
    assert_eq!((first.0, first.1), (200, 300));
    // A ring: what is in the middle of the upper picture is what is behind it, and the ring is not.
    let at = |x: usize, y: usize| first.2[3 * (200 * y + x)];
    assert!(at(3, 3) > 240 && (150..200).any(|x| at(x, 75) < 220));
    for threads in ["1", "3"] {
        assert!(picture(&folder, &[&scan], &[&args[..], &["--threads", threads]].concat()) == first);
    }
    let shuffled = folder.scan("b", &mesh.clone().with_shuffled_faces(), Kind::Floats);
    let soup = folder.scan("c", &mesh, Kind::Stl);
    let both = picture(&folder, &[&scan, &soup], &["--width", "200", "--height", "150"]);
    assert_eq!((both.0, both.1), (400, 150));
    let half = |x: usize| (0..150).flat_map(move |y| (0..600).map(move |i| 3 * (400 * y + x) + i)).collect::<Vec<_>>();
    assert!(half(0).iter().zip(half(200)).all(|(&a, b)| both.2[a] == both.2[b]), "a soup looks different");
    // Another order of faces may begin a triangle at another corner: rounding moves a sample here and there.
    let other = picture(&folder, &[&shuffled], &args);
    let differ = first.2.iter().zip(&other.2).filter(|(a, b)| a.abs_diff(**b) > 8).count();
    assert!(differ < first.2.len() / 200, "{differ} of {}", first.2.len());
}

#[test]
fn a_scan_that_does_not_fit_is_drawn_all_the_same() {
    let folder = Folder::new();
    let scan = folder.synth("scan.ply", "2M");
    let args = ["--width", "160", "--height", "160", "--zoom", "5"];
    let exact = picture(&folder, &[&scan], &args);
    let outcome = render(&folder, &[&scan], &[&args[..], &["--memory", "32MiB"]].concat());
    assert_eq!(outcome.code, Some(0), "{}", outcome.stderr);
    let peak = outcome.object["peak_rss_bytes"].as_u64();
    assert!(peak.is_none_or(|peak| peak <= 32 << 20), "{peak:?}");
    let dots = picture(&folder, &[&scan], &[&args[..], &["--memory", "32MiB"]].concat());
    let far = |range: std::ops::Range<usize>| {
        let pairs = exact.2[range.clone()].iter().zip(&dots.2[range]);
        pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / (3 * 160 * 160) as f64
    };
    // Dots shade a little differently; what is zoomed in on is drawn by its triangles.
    assert!(far(0..3 * 160 * 160) < 12.0, "{}", far(0..3 * 160 * 160));
}

#[test]
fn what_cannot_be_drawn_is_told() {
    let folder = Folder::new();
    let good = folder.scan("good", &field(20, 20), Kind::Doubles);
    let bad = folder.file("bad.ply", b"ply\n");
    assert!(render(&folder, &[&good, &bad], &[]).failed(1).contains("bad.ply"));
    assert!(render(&folder, &[&good], &["--width", "90000"]).failed(2).contains("pixels wide"));
    assert!(
        render(&folder, &[&good], &["--width", "6000", "--memory", "64MiB"]).failed(2).contains("within this budget")
    );
    let mut command = program();
    command.arg("render").arg(&good).arg("-o").arg(folder.path("out.jpg")).arg("--json");
    assert!(Outcome::of(command, PathBuf::new()).failed(2).contains(".png"));
    assert_eq!(folder.names(), ["bad.ply", "good.ply"]);
}
