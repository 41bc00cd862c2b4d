#!/usr/bin/env bash
# Instructions by stage, on one thread, as valgrind's callgrind counts them: nearly the same whatever else a machine does,
# so that a change of a few parts in a hundred shows where times scatter more.
#
#   benches/instructions.sh [FACES]        faces of the scan that is made, 200000 unless said
#
# MESHMILL names the program, else the release build is used.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

faces=${1:-200000}
program=${MESHMILL:-}
if [[ -z $program ]]; then
    cargo build --release --quiet
    program=target/release/meshmill
fi
# Otherwise the program would start once more to set these, unseen.
export GLIBC_TUNABLES=glibc.malloc.mmap_threshold=4194304:glibc.malloc.trim_threshold=8388608
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

"$program" synth "$folder/scan.ply" --faces "$faces" --seed 7 >/dev/null 2>&1

# Instructions of a run within a budget, of all of it or while it is in some functions.
count() {
    local memory=$1 functions=()
    for function in "${@:2}"; do functions+=("--toggle-collect=meshmill::$function"); done
    [[ $# -eq 1 ]] || functions+=(--collect-atstart=no)
    valgrind --tool=callgrind --callgrind-out-file=/dev/null "${functions[@]}" \
        "$program" reduce "$folder/scan.ply" -o "$folder/small.ply" --faces $((faces / 50)) \
        --memory "$memory" --threads 1 2>&1 >/dev/null | sed -n 's/.*Collected : //p'
}

line() {
    printf '  %-30s %14d %7d a face\n' "$1" "$2" $(($2 / faces))
}

for memory in 25MiB 1GiB; do
    echo "$faces faces to $((faces / 50)) within $memory"
    all=$(count "$memory")
    collapse=$(count "$memory" collapse::collapse)
    refit=$(count "$memory" refit::refit mesh::samples::SampleFile::load)
    line 'reading, clustering, writing' $((all - collapse - refit))
    line collapse "$collapse"
    line 'refit, with its samples' "$refit"
    line 'in all' "$all"
done
