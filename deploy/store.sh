#!/bin/sh
# Makes the bucket's folder, reads the keys from files, then executes the S3 store.
set -eu
mkdir -p /data/biresnerf
ROOT_ACCESS_KEY_ID=$(cat /run/secrets/storage_access_key_id)
ROOT_SECRET_ACCESS_KEY=$(cat /run/secrets/storage_secret_access_key)
export ROOT_ACCESS_KEY_ID ROOT_SECRET_ACCESS_KEY
exec versitygw --port :7070 --health /healthz --quiet posix /data
