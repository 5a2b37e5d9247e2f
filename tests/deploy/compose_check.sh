#!/usr/bin/env bash
# Builds the image, runs compose.yaml for real with podman, loses a worker in mid job, and sees the result. Then loses
# database and files, and sees it again from a backup.
#
#   make compose-check                       (root; Debian or Ubuntu; 10 GB in $TMPDIR; a quarter of an hour or more)
#   KEEP=1 make compose-check                keeps the images for the next time
#   FIGURES=file make compose-check          writes what was measured to a file, too
#
# Where no registry is reached, stand-ins from Debian's packages take the place of the images that the Dockerfile and
# compose.yaml name; the Dockerfile and compose.yaml are the same. Exit status: 0 passed, 77 skipped, 1 failed.
set -euo pipefail
cd "$(dirname "$0")/../.."
here=tests/deploy
work=${WORK:-${TMPDIR:-/tmp}/biresnerf-compose-check}
project=biresnerf-check
port=${PORT:-18080}
url=http://127.0.0.1:$port
python_image=docker.io/library/python:3.11-slim-bookworm
export CONTAINERS_CONF=$work/containers.conf CONTAINERS_STORAGE_CONF=$work/storage.conf

say() { printf '== %s  %s\n' "$(date +%T)" "$*"; }
skip() { echo "skipped: $*"; exit 77; }
fail() { echo "FAILED: $*" >&2; exit 1; }
figure() { printf '%-34s %s\n' "$1" "$2" | tee -a "$work/figures"; }
now() { date +%s.%N; }
since() { python3 -c "print(f'{$(now) - $1:.1f}')"; }
by_service() { podman ps -q --filter "label=com.docker.compose.project=$project" --filter "label=com.docker.compose.service=$1"; }
# Without a pipe that ends early, which would end the script.
one_of() { local all; all=$(by_service "$1"); echo "${all%%$'\n'*}"; }
all_of() { podman ps -aq --filter "label=com.docker.compose.project=$project" --filter "label=com.docker.compose.service=$1"; }
compose() { COMPOSE_PROFILES=cpu "$work/venv/bin/podman-compose" --in-pod=false -p "$project" --profile cpu "$@"; }
of_backups() { "$work/venv/bin/podman-compose" --in-pod=false -p "$project" --profile backup run --rm backup "$@"; }

# --- what it needs -----------------------------------------------------------------------------------------------

needs() {
  [ "$(uname -s)" = Linux ] || skip "Linux only"
  [ "$(id -u)" = 0 ] || skip "needs root, to make base images and networks"
  local packages="podman buildah runc catatonit netavark aardvark-dns iptables uidmap debootstrap python3-venv" lacking=""
  for package in $packages; do dpkg -s "$package" >/dev/null 2>&1 || lacking="$lacking $package"; done
  if [ -n "$lacking" ]; then
    command -v apt-get >/dev/null || skip "these packages are needed:$lacking"
    say "installing$lacking"
    # shellcheck disable=SC2086 # a list
    { apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends $lacking; } \
      >"$work/apt.log" 2>&1 || skip "these packages cannot be had:$lacking ($work/apt.log)"
  fi
  local free; free=$(df --output=avail -BG "$work" | tail -1 | tr -dc 0-9)
  [ "$free" -ge 10 ] || skip "10 GB are needed in $work, $free are free"
}

settings() {
  local driver=vfs; mkdir -p "$work"/{lower,upper,inner,merged}
  if mount -t overlay overlay -o "lowerdir=$work/lower,upperdir=$work/upper,workdir=$work/inner" "$work/merged" 2>/dev/null
  then umount "$work/merged"; driver=overlay; fi
  printf '[storage]\ndriver="%s"\ngraphroot="%s/storage"\nrunroot="%s/run"\n' "$driver" "$work" "$work" > "$work/storage.conf"
  # runc with plain cgroups: works on hosts without systemd, too.
  cat > "$work/containers.conf" <<CONF
[containers]
default_ulimits=["nofile=1024:1024","nproc=4096:4096"]
[network]
network_backend="netavark"
[engine]
runtime="runc"
cgroup_manager="cgroupfs"
events_logger="file"
CONF
  python3 -m venv "$work/venv"
  "$work/venv/bin/pip" install -q podman-compose==1.6.0 || skip "podman-compose cannot be had"
}

# This machine's settings of pip and npm, and the folders they name, for the builds alone: none of it is in an image.
build_mounts() {
  python3 - "$work/pip.conf" <<'PY'
import ast, re, subprocess, sys
from pathlib import Path
found = {}
for line in subprocess.run(["pip", "config", "list"], capture_output=True, text=True).stdout.splitlines():
    name, _, value = line.partition("=")
    key = name.rpartition(".")[2]
    if key in {"index-url", "extra-index-url", "find-links", "cert", "trusted-host"}:
        found[key] = ast.literal_eval(value)
Path(sys.argv[1]).write_text("[global]\n" + "".join(f"{k} = {' '.join(v.split())}\n" for k, v in found.items()))
words = [re.sub(r"^file://", "", word) for value in found.values() for word in value.split()]
folders = {word.removesuffix("/simple") for word in words if word.startswith("/")}
print(*(f"-v {path}:{path}:ro" for path in sorted(folders) if Path(path).exists()))
PY
  echo "-v $work/pip.conf:/etc/pip.conf:ro"
  local bundle=/etc/ssl/certs/ca-certificates.crt
  [ ! -e "$bundle" ] || echo "-v $bundle:$bundle:ro"
  # npm's registry and certificates; it goes by no system's bundle.
  { [ ! -e "$bundle" ] || echo "cafile=$bundle"
    ! command -v npm >/dev/null || echo "registry=$(npm config get registry 2>/dev/null)"; } > "$work/npmrc"
  echo "-v $work/npmrc:/root/.npmrc:ro"
}

build() { # image, arguments…
  local image=$1; shift
  # shellcheck disable=SC2046 # lists
  buildah bud --isolation chroot --format docker --layers $(build_mounts) -t "$image" "$@" \
    >"$work/build-${image##*/}.log" 2>&1 || { tail -20 "$work/build-${image##*/}.log"; fail "building $image"; }
}

# --- images ------------------------------------------------------------------------------------------------------

base_images() {
  if podman image exists "$python_image" || timeout 60 podman pull -q "$python_image" >/dev/null 2>&1; then
    say "base image: $(podman image inspect "$python_image" --format '{{.Id}} {{.Created}}')"
  else
    say "no registry: base image from Debian's packages"
    debootstrap --variant=minbase --include=python3,python3-venv,python3-pip,ca-certificates bookworm \
      "$work/root" >"$work/debootstrap.log" 2>&1 || skip "debootstrap failed ($work/debootstrap.log)"
    ln -sf /usr/bin/python3 "$work/root/usr/local/bin/python"
    rm -rf "$work/root"/var/cache/apt/archives/*.deb "$work/root"/var/lib/apt/lists/*
    tar -C "$work/root" -c . | podman import - "$python_image" >/dev/null
    rm -rf "$work/root"
    touch "$work/standins"
  fi
  stand_in NGINX_IMAGE docker.io/library/nginx:1.28-bookworm nginx
  stand_in POSTGRES_IMAGE docker.io/library/postgres:17-bookworm postgres
  stand_in STORE_IMAGE ghcr.io/versity/versitygw:v1.7.0 store
}

stand_in() { # variable of compose.yaml, image it names, name of the stand-in
  if [ ! -e "$work/standins" ] && timeout 120 podman pull -q "$2" >/dev/null 2>&1; then export "$1=$2"; return; fi
  say "stand-in for $2"
  build "localhost/standin-$3" -f "$here/standins/$3.Containerfile" "$here/standins"
  export "$1=localhost/standin-$3:latest"
}

our_image() {
  say "building the image"
  local began index=""; began=$(now)
  # An index of CPU builds that is not reached is left to pip's own settings (a wheel folder, a mirror).
  curl -sfm 20 -o /dev/null https://download.pytorch.org/whl/cpu/torch/ || index="--build-arg TORCH_INDEX=https://pypi.org/simple"
  # shellcheck disable=SC2086 # none or two words
  build localhost/biresnerf:latest $index --build-arg "REVISION=$(git rev-parse HEAD 2>/dev/null || echo unknown)" .
  figure "image: build, s" "$(since "$began")"
  figure "image: size, MB" "$(podman image inspect localhost/biresnerf:latest --format '{{.Size}}' | awk '{printf "%.0f", $1/1e6}')"
}

# --- the run -----------------------------------------------------------------------------------------------------

up() {
  [ -e secrets ] || made_secrets=1
  sh deploy/prepare.sh >/dev/null
  say "compose up, two workers"
  local began; began=$(now)
  export BIRESNERF_PUBLISH=127.0.0.1:$port
  # podman before 4.6 knows no conditions of dependencies, so it is waited for here that the database is there.
  compose up -d migrate postgres store >"$work/up.log" 2>&1 || { tail "$work/up.log"; fail "compose up"; }
  until [ "$(podman inspect "$(all_of migrate)" --format '{{.State.Status}} {{.State.ExitCode}}')" = "exited 0" ]; do
    [ "$(since "$began" | cut -d. -f1)" -lt 300 ] || { logs; fail "not migrated after 300 s"; }
    sleep 0.5
  done
  compose up -d --scale worker=2 >>"$work/up.log" 2>&1 || { tail -20 "$work/up.log"; fail "compose up"; }
  until curl -sfo /dev/null "$url/readyz"; do
    [ "$(since "$began" | cut -d. -f1)" -lt 300 ] || { podman ps -a; logs; fail "not ready after 300 s"; }
    sleep 0.5
  done
  figure "up: until ready, s" "$(since "$began")"
}

logs() { for service in migrate api worker proxy postgres store; do compose logs "$service" 2>&1 | tail -15; done; }
in_image() { podman run --rm --network host -v "$work/scene:/scene" -e BIRESNERF_API_KEY="$key" "$@"; }
job() { curl -sf -H "Authorization: Bearer $key" "$url/v1/jobs/$1"; }
of_job() { job "$1" | python3 -c "import json,sys; print(json.load(sys.stdin)['$2'])"; }

hardened() {
  say "what the containers may not do"
  local worker; worker=$(one_of worker)
  [ "$(podman exec "$worker" id -u)" = 10001 ] || fail "the worker runs as root"
  ! podman exec "$worker" sh -c 'echo > /opt/venv/x' 2>/dev/null || fail "the root file system can be written to"
  podman exec "$worker" grep -q '^CapEff:[[:space:]]*0000000000000000' /proc/self/status || fail "the worker has capabilities"
  podman exec "$worker" grep -q '^NoNewPrivs:[[:space:]]*1' /proc/self/status || fail "new privileges can be had"
  ! podman exec "$worker" sh -c 'tr "\0" "\n" < /proc/1/environ' | grep -q 'postgresql://' || fail "the password is in the environment"
  ! podman exec "$worker" python -c 'import socket; socket.create_connection(("1.1.1.1", 443), 5)' 2>/dev/null || fail "a worker reaches the internet"
  for service in postgres store api; do
    [ -z "$(podman port "$(by_service $service)")" ] || fail "$service is published"
  done
  [ "$(curl -so /dev/null -w '%{http_code}' "$url/metrics")" = 404 ] || fail "the proxy shows the metrics"
  [ "$(curl -so /dev/null -w '%{http_code}' "$url/v1/jobs")" = 401 ] || fail "jobs are listed without a key"
  curl -s -H 'Content-Length: 99999999999' -X POST "$url/v1/datasets" | grep -q body_too_large || fail "no cap on bodies"
  for service in api worker; do
    podman healthcheck run "$(one_of $service)" >/dev/null || fail "$service is not healthy"
  done
}

lose_a_worker() {
  rm -rf "$work/scene"; mkdir -p "$work/scene"; chmod 0777 "$work/scene"
  in_image localhost/biresnerf:latest biresnerf make-scene /scene/in --views 16 --size 64 --noise 0.1 --seed 1 >/dev/null
  say "submitting a job"
  in_image localhost/biresnerf:latest biresnerf submit /scene/in --preset fast --set steps=600 --set verdict=false --set checkpoint_every_s=5 \
    --set orbit_frames=0 --url "$url" >"$work/submit.log" 2>&1 || { cat "$work/submit.log"; fail "submit"; }
  local id holder began; id=$(grep -o 'job_[0-9A-Z]*' "$work/submit.log" | sed -n 1p)
  local started; started=$(now)
  until [ "$(of_job "$id" stage)" = coarse ]; do still "$id" "$started" 900; sleep 1; done
  sleep 8 # past a first checkpoint
  holder=$(for one in $(by_service worker); do
    if podman exec "$one" sh -c 'ls -d /var/lib/biresnerf/scratch/*/job_* >/dev/null 2>&1'; then echo "$one"; fi; done)
  [ -n "$holder" ] || fail "no worker holds the job"
  say "removing worker $holder in mid job: $(job "$id" | cut -c 1-400)"
  began=$(now)
  podman rm --force --time 0 "$holder" >/dev/null
  until [ "$(of_job "$id" attempt)" = 2 ] && [ "$(of_job "$id" state)" = running ]; do still "$id" "$began" 300; sleep 0.5; done
  figure "worker lost: taken over after, s" "$(since "$began")"
  until [ "$(of_job "$id" state)" != running ] && [ "$(of_job "$id" state)" != queued ]; do still "$id" "$began" 1500; sleep 2; done
  [ "$(of_job "$id" state)" = succeeded ] || { job "$id"; fail "the job did not succeed"; }
  figure "job: from start to result, s" "$(since "$started")"
  curl -sf -H "Authorization: Bearer $key" "$url/v1/jobs/$id/artifacts" | python3 -c "
import json, sys
names = [item['name'] for item in json.load(sys.stdin)['items']]
assert 'transforms.json' in names and len(names) == len(set(names)), names
print(len(names), 'files in the result')"
  curl -sf -H "Authorization: Bearer $key" "$url/v1/jobs/$id/artifacts/transforms.json" -o "$work/transforms.json"
  python3 -c "import json; assert len(json.load(open('$work/transforms.json'))['frames']) == 16"
  lose_all_but_backups "$id"
}

# The database and the files are lost, the backups are not.
lose_all_but_backups() {
  say "backup, loss of database and files, restore"
  local id=$1 before; before=$(job "$id")
  of_backups >"$work/backup.log" 2>&1 || { cat "$work/backup.log"; fail "backup"; }
  compose down -t 20 >"$work/lost.log" 2>&1
  # podman-compose leaves the second worker and what that needs, and reports nothing.
  podman ps -aq --filter "label=com.docker.compose.project=$project" | xargs -r podman rm --force --ignore --depend >>"$work/lost.log" 2>&1
  podman volume rm "${project}_database" "${project}_files" >/dev/null
  compose up -d postgres store >>"$work/lost.log" 2>&1
  local began; began=$(now)
  until podman healthcheck run "$(by_service postgres)" >/dev/null && podman healthcheck run "$(by_service store)" >/dev/null; do
    [ "$(since "$began" | cut -d. -f1)" -lt 120 ] || { logs; fail "no database after 120 s"; }
    sleep 0.5
  done
  of_backups biresnerf restore /backups/biresnerf >"$work/restore.log" 2>&1 || { cat "$work/restore.log"; fail "restore"; }
  compose up -d >>"$work/lost.log" 2>&1
  until curl -sfo /dev/null "$url/readyz"; do
    [ "$(since "$began" | cut -d. -f1)" -lt 300 ] || { logs; fail "not ready after the restore"; }
    sleep 0.5
  done
  figure "restore: until ready again, s" "$(since "$began")"
  # When it expires is reckoned a moment after its end.
  diff <(echo "$before" | json_but expires_at) <(job "$id" | json_but expires_at) || fail "the job is another after the restore"
  curl -sf -H "Authorization: Bearer $key" "$url/v1/jobs/$id/artifacts/transforms.json" | cmp - "$work/transforms.json"
}

json_but() { python3 -c "import json, sys; found = json.load(sys.stdin); found.pop('$1'); print(json.dumps(found, indent=1))"; }
still() { [ "$(since "$2" | cut -d. -f1)" -lt "$3" ] || { job "$1"; logs; fail "waited $3 s"; }; }

down() {
  local status=$?
  trap - EXIT
  if [ -x "$work/venv/bin/podman-compose" ]; then
    [ "$status" = 0 ] || [ "$status" = 77 ] || logs >"$work/logs" 2>&1 || true
    compose down -v -t 20 >"$work/down.log" 2>&1 || true
  fi
  podman rm --all --force --depend --volumes >/dev/null 2>&1 || true # of our own storage alone, as all that podman does here
  podman volume rm --all --force >/dev/null 2>&1 || true # KEEP keeps images
  if [ "${made_secrets:-0}" = 1 ]; then rm -rf secrets .env; fi
  if [ "${KEEP:-0}" != 1 ]; then
    podman rmi --all --force >/dev/null 2>&1 || true
    ! mountpoint -q "$work/storage/overlay" || umount "$work/storage/overlay"
    rm -rf "$work"
  fi
  exit "$status"
}

mkdir -p "$work"
: > "$work/figures"
trap down EXIT
needs
settings
base_images
our_image
up
key=""
key=$(podman exec "$(by_service api)" biresnerf keys create check --scope admin)
hardened
lose_a_worker
[ -z "${FIGURES:-}" ] || cp "$work/figures" "$FIGURES"
say "passed"
