#!/usr/bin/env bash
# A night as a Slurm job array, one part a task, on nodes that share a file system.
#
#   sbatch --array=1-16 configs/slurm-array.sh night.toml
#   sbatch --dependency=afterany:JOBID --wrap 'meshmill report merge FOLDER/report.*-of-16.json -o FOLDER'
#
# --mem is what Slurm allows a task: a little more than [night] memory. A task that is killed or requeued goes on where it
# was; when a task's time is nearly over, Slurm sends SIGTERM, and the scan under way is begun again by the next try.
#SBATCH --job-name=meshmill
#SBATCH --cpus-per-task=2
#SBATCH --mem=3G
#SBATCH --time=08:00:00
#SBATCH --signal=B:TERM@60
#SBATCH --requeue
set -euo pipefail
job=${1:?usage: sbatch --array=1-N slurm-array.sh JOB.toml}
meshmill=${MESHMILL:-meshmill}

# The shell waits so that the signal reaches the run through it.
"$meshmill" run "$job" --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" &
trap 'kill -TERM $!' TERM
wait $! || wait $!
