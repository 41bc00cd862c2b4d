#!/usr/bin/env bash
# A night in N parts side by side on one machine, by GNU parallel; on several, with --sshlogin and a shared file system.
#
#   configs/gnu-parallel.sh night.toml 4
#
# The parts keep ledgers of their own in the night's folder: the same command goes on where it was ended. Memory is the
# night's for each part: divide what the machine has.
set -euo pipefail
job=${1:?usage: gnu-parallel.sh JOB.toml PARTS}
parts=${2:?usage: gnu-parallel.sh JOB.toml PARTS}
meshmill=${MESHMILL:-meshmill}

folder=$("$meshmill" run "$job" --dry-run --json 2>/dev/null | sed -n 's/.*"folder":"\([^"]*\)".*/\1/p')
[[ -n $folder ]] || exec "$meshmill" run "$job" --dry-run

status=0
seq "$parts" | parallel --halt never "$meshmill" run "$job" --shard "{}/$parts" || status=1
"$meshmill" report merge "$folder"/report.*-of-"$parts".json -o "$folder"
exit "$status"
