#!/bin/bash
# A sweep as a Slurm array: `sbatch docs/cluster/slurm-array.sh runs/sweep`. Each task does one part in 32 of the jobs.
#SBATCH --job-name=cpdeform
#SBATCH --array=0-31
#SBATCH --cpus-per-task=1
#SBATCH --mem=2G
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=TERM@60
# `exec`: the signal, a minute before the time is over, has to reach the worker, which then gives its job back.
exec cpdeform sweep work "$1" --workers 1 --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT"
