#!/bin/sh
# Builds the image's last stage from finished programs, looks into it, runs it, and talks to it with real rclpy.
#
#     docker/test.sh [PROGRAMS]     PROGRAMS: a folder that docker/static.sh has filled, by default target/static,
#                                   which is filled first where it is empty
#
# It needs podman and runc, and no Docker engine (Debian, Ubuntu: apt install podman runc). Nothing is fetched:
# the last stage is built from docker/Dockerfile itself, with a folder in place of the stage that compiles. So it
# does not test that stage, which runs docker/image.sh on a public base image.
set -eu
programs=${1:-target/static}
case $programs in
/*) ;;
*) [ -z "${1:-}" ] || programs=$(pwd)/$programs ;;
esac
cd "$(dirname "$0")/.."

say() {
    printf '\n== %s\n' "$*"
}

fail() {
    echo "docker/test: $*" >&2
    exit 1
}

for tool in podman runc python3 flock; do
    command -v $tool >/dev/null || fail "$tool not found (Debian, Ubuntu: apt install podman runc util-linux)"
done
if ! [ -x "$programs/tcvae_node" ] || ! [ -x "$programs/tcvae" ]; then
    docker/static.sh "$programs"
fi
# Domain 0 may have a robot in it; the lock is that of the tests in tests/interop.
domain=87
exec 9>"${TMPDIR:-/tmp}/tcvae-test-domain-$domain.lock"
flock -w 60 9 || fail "ROS domain $domain is in use by other tests"

scratch=$(mktemp -d)
engine() {
    podman --root "$scratch/storage" --runroot "$scratch/run" --storage-driver vfs --runtime runc \
        --cgroup-manager cgroupfs "$@"
}
cleanup() {
    engine rm --all --force >"$scratch/removed" 2>&1 || true
    engine umount --all >>"$scratch/removed" 2>&1 || true
    rm -rf "$scratch"
}
trap cleanup EXIT

say "the image"
docker/image.sh "$scratch/build/image" "$programs"
engine build --isolation chroot --build-context "build=$scratch/build" --target image \
    --file docker/Dockerfile --tag tcvae docker >"$scratch/log" 2>&1 || {
    cat "$scratch/log"
    fail "the image could not be built, see above"
}

# What the image says of itself.
said() {
    engine image inspect --format "$1" tcvae
}
expect() {
    [ "$2" = "$3" ] || fail "the $1 is '$2', not '$3'"
    echo "$1: $2"
}
expect user "$(said '{{.User}}')" 65532:65532
expect "entry point" "$(said '{{join .Config.Entrypoint " "}}')" /usr/local/bin/tcvae_node
expect "signal to stop" "$(said '{{.Config.StopSignal}}')" SIGINT
version=$("$programs/tcvae_node" --version)
expect version "$(said '{{index .Labels "org.opencontainers.image.version"}}')" "${version#tcvae_node }"

say "what is in it"
engine create --name unpacked tcvae >/dev/null
engine export unpacked >"$scratch/unpacked.tar"
engine rm unpacked >/dev/null
mkdir "$scratch/unpacked"
tar -C "$scratch/unpacked" -xpf "$scratch/unpacked.tar"
# The engine makes the empty mount points of every container.
find "$scratch/unpacked" -mindepth 1 -type f -size +0 -printf '%P\n' | sort >"$scratch/files"
cat >"$scratch/wanted" <<'END'
usr/local/bin/tcvae
usr/local/bin/tcvae_node
usr/share/doc/tcvae/LICENSE-APACHE
usr/share/doc/tcvae/LICENSE-MIT
END
diff "$scratch/wanted" "$scratch/files" || fail "the image holds other files than it should, see above"
cat "$scratch/files"
[ "$(stat -c %a "$scratch/unpacked/tmp")" = 1777 ] || fail "/tmp is not open to every user"
for program in tcvae tcvae_node; do
    if readelf -lW "$scratch/unpacked/usr/local/bin/$program" | grep -q INTERP; then
        fail "$program is not static"
    fi
done
echo "size: $(($(said '{{.Size}}') / 1048576)) MiB"

say "the trainer in the container"
run() {
    # No more rights than docker/compose.yaml gives; limits that are allowed everywhere.
    engine run --read-only --tmpfs /tmp --cap-drop all --security-opt no-new-privileges \
        --ulimit nofile=1024:1024 --ulimit nproc=1024:1024 "$@"
}
run --rm --network none --volume "$(pwd)/models:/data:ro" --entrypoint /usr/local/bin/tcvae tcvae \
    sample /data/pouring.safetensors --task pour_location=0.65,0.35 --task source_cup=0.60,0.10 --json \
    >"$scratch/sample.json"
python3 - "$scratch/sample.json" <<'END'
import json, sys
answer = json.load(open(sys.argv[1]))
assert answer["error_code"] == 0, answer["error_message"]
print(len(answer["samples"]), "sample")
END

say "the node in the container"
python=$(python3 tests/interop/environment.py kilted)
run --detach --name node --network host --env ROS_DOMAIN_ID=$domain --env ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST \
    tcvae >/dev/null
status=0
env -i HOME="$HOME" PATH="$PATH" PYTHONPATH=tests/interop "$python" docker/ask.py $domain || status=$?
[ "$status" -eq 0 ] || {
    engine logs node
    fail "the node did not answer as it should, see above"
}
began=$(date +%s)
engine stop --time 10 node >/dev/null
expect "exit code after podman stop" "$(engine inspect --format '{{.State.ExitCode}}' node)" 0
echo "stopped in $(($(date +%s) - began)) s"
engine logs node 2>&1 | grep -q "SIGINT: leaving" || fail "the node did not say that it leaves"

say "passed"
