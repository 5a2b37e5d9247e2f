#!/bin/bash
# A worker for one job in a Slurm allocation: submit_workers.py submits it as `worker.sh cpu` or `worker.sh gpu`.
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=2
#SBATCH --mem=8G
#SBATCH --time=08:00:00
# SIGTERM two minutes before the time is over: the job writes a checkpoint and goes on in another allocation.
#SBATCH --signal=B:TERM@120
# The queue tries again, not Slurm: a requeued worker waits two minutes, and no other is submitted for its job meanwhile.
#SBATCH --no-requeue
#SBATCH --open-mode=append
#SBATCH --output=biresnerf-%A_%a.log
set -euo pipefail

# Variables of docs/settings.md, the same on all hosts.
set -a
# shellcheck source=/dev/null
. "${BIRESNERF_WORKER_SETTINGS:-/etc/biresnerf/worker.env}"
set +a
# As many threads as processors were asked for: libraries count those of the node.
export OMP_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1} NUMBA_NUM_THREADS=${SLURM_CPUS_PER_TASK:-1}
# In the shell's place, so that Slurm's signals reach it.
exec "${BIRESNERF:-biresnerf}" worker --free-slot "${1:-cpu}" --one-job --idle-exit "${BIRESNERF_IDLE_EXIT_S:-30}"
