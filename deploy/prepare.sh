#!/bin/sh
# Creates what compose.yaml needs: secrets/ with random keys, and .env. Changes no existing file.
#   sh deploy/prepare.sh          jobs run on the CPU
#   sh deploy/prepare.sh gpu      jobs run on one NVIDIA GPU
set -eu
cd "$(dirname "$0")/.."
profile=${1:-cpu}
case "$profile" in cpu | gpu) ;; *) echo "usage: $0 [cpu|gpu]" >&2; exit 2 ;; esac

random() { head -c "$1" /dev/urandom | od -An -tx1 | tr -d ' \n'; }
secret() { [ -e "secrets/$1" ] || printf '%s' "$2" > "secrets/$1"; }

# The folder keeps others out; the files are readable because the processes in the containers are not root.
mkdir -p secrets && chmod 0700 secrets
umask 0222
secret database_password "$(random 24)"
secret database_url "postgresql://biresnerf:$(cat secrets/database_password)@postgres:5432/biresnerf"
secret storage_access_key_id "$(random 10)"
secret storage_secret_access_key "$(random 24)"
secret metrics_token "$(random 24)"
umask 0022
if [ ! -e .env ]; then
  { echo "COMPOSE_PROFILES=$profile"
    echo "# Where the service is published. Others than this machine need compose.tls.yaml, too."
    echo "BIRESNERF_PUBLISH=127.0.0.1:8080"; } > .env
fi
echo "secrets/ and .env are ready."
