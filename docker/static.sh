#!/bin/sh
# Builds tcvae_node and tcvae as statically linked programs: one file each, with the model and the robot inside,
# which run on any Linux of this machine's architecture, with no libraries beside them.
#
#     docker/static.sh [FOLDER]     puts them into FOLDER (by default target/static, in the repository)
#
# It needs what `./x setup` and cargo need, a C compiler, and the C library's static archive (Debian, Ubuntu:
# libc6-dev; Fedora: glibc-static). CARGO_TARGET_DIR and RUSTFLAGS are followed.
set -eu

output=${1:-}
case $output in
/* | "") ;;
*) output=$(pwd)/$output ;;
esac
cd "$(dirname "$0")/.."
output=${output:-$(pwd)/target/static}

fail() {
    echo "static: $*" >&2
    exit 1
}

command -v cargo >/dev/null || fail "cargo not found; install Rust from https://rustup.rs"
version=$(rustc -vV) || fail "rustc does not run, see above"
host=$(echo "$version" | sed -n 's/^host: //p')
case $host in
*-linux-*) ;;
*) fail "this recipe is for Linux, and rustc's host is $host; build inside docker/Dockerfile instead" ;;
esac

# The usual obstacle, told before the long build instead of after it.
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
echo 'int main(void) { return 0; }' >"$scratch/probe.c"
"${CC:-cc}" -static -o "$scratch/probe" "$scratch/probe.c" 2>"$scratch/why" || {
    cat "$scratch/why" >&2
    fail "${CC:-cc} can't link statically, see above; install the C compiler and the static C library" \
        "(Debian, Ubuntu: apt install gcc libc6-dev; Fedora: dnf install gcc glibc-static)"
}

./x setup
# With --target the flags hold for the programs alone; build scripts and macros, which run here, stay as they are.
RUSTFLAGS="${RUSTFLAGS:-} -C target-feature=+crt-static" \
    cargo build --release --locked --bins --target "$host"
target=$(cargo metadata --locked --no-deps --format-version 1 |
    python3 -c 'import json, sys; print(json.load(sys.stdin)["target_directory"])')

mkdir -p "$output"
for program in tcvae_node tcvae; do
    built=$target/$host/release/$program
    # A program that asks for a loader is not static, whatever the flags were.
    if readelf -lW "$built" | grep -q INTERP; then
        fail "$built asks for the dynamic loader: it is not static"
    fi
    strip -o "$output/$program" "$built"
    "$output/$program" --version
    echo "static: $output/$program, $(($(wc -c <"$output/$program") / 1048576)) MiB"
done
