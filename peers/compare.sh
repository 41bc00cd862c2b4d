#!/usr/bin/env bash
# meshmill and meshoptimizer's simplifier with update on one scan, in turn: medians of wall time, CPU time and peak
# memory, and how many times over the peer takes each (the median of the turns, which a busy machine disturbs least).
#
#   peers/compare.sh SCAN FACES [MEMORY]
#
# SCAN is a binary little-endian PLY of float positions and triangles. Set in the environment: RUNS (3), THREADS
# (meshmill's; the cores), PEER (further options of the peer, such as `--sloppy-first 10`).
set -euo pipefail
if (($# < 2 || $# > 3)); then
    sed -n '2,/^set/{/^#/s/^# \{0,1\}//p}' "$0" >&2
    exit 2
fi
scan=$1 faces=$2 memory=${3:-512MiB}
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
cargo build --release --quiet --manifest-path "$here/../Cargo.toml"
cargo build --release --quiet --manifest-path "$here/Cargo.toml"
mill=${CARGO_TARGET_DIR:-$here/../target}/release/meshmill
peer=${CARGO_TARGET_DIR:-$here/target}/release/meshopt-simplify

out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
TIMEFORMAT='%R %U %S'

# Runs a command: its JSON and its times, one line each, are added to a file.
turn() {
    local log=$1
    shift
    { time "$@" >"$out/json" 2>"$out/words"; } 2>"$out/times" || {
        cat "$out/words" >&2
        exit 1
    }
    cat "$out/json" "$out/times" >>"$log"
}

# Both find the scan in the page cache, as far as it holds it.
cat "$scan" >/dev/null
for ((run = 0; run < ${RUNS:-3}; run++)); do
    turn "$out/mill" "$mill" reduce "$scan" -o "$out/mill.ply" --faces "$faces" --memory "$memory" \
        ${THREADS:+--threads "$THREADS"} --json
    # shellcheck disable=SC2086 # options are words
    turn "$out/peer" "$peer" "$scan" "$out/peer.ply" --faces "$faces" ${PEER:-}
done

python3 - "$out/mill" "$out/peer" <<'PY'
import json, statistics, sys

def runs(path, algorithm, faces):
    lines = open(path).read().splitlines()
    for said, times in zip(lines[::2], lines[1::2]):
        said, (wall, user, system) = json.loads(said), map(float, times.split())
        yield wall, user + system, algorithm(said), said["peak_rss_bytes"] / 2**20, faces(said)

def mill_algorithm(said):
    return (said["seconds"]["cluster"] or 0) + said["seconds"]["collapse"]

mill = list(runs(sys.argv[1], mill_algorithm, lambda said: said["output"]["faces"]))
peer = list(runs(sys.argv[2], lambda said: said["algo_s"], lambda said: said["out_faces"]))
print(f"{'median of ' + str(len(mill)):<22}{'meshmill':>12}{'peer':>12}{'peer/meshmill':>15}")
rows = [("wall, s", 2), ("CPU, s", 2), ("algorithm alone, s", 2), ("peak memory, MiB", 0), ("faces", 0)]
for (name, digits), ours, theirs in zip(rows, zip(*mill), zip(*peer)):
    ratio = statistics.median(t / o for o, t in zip(ours, theirs))
    ours, theirs = statistics.median(ours), statistics.median(theirs)
    print(f"{name:<22}{ours:>12.{digits}f}{theirs:>12.{digits}f}{ratio:>15.2f}")
PY
