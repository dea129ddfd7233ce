#!/bin/sh
# Lays out the root of the image: the two programs, their licences, an empty /tmp, and /data to mount files at.
#
#     docker/image.sh FOLDER [PROGRAMS]     PROGRAMS: a folder that docker/static.sh has filled; without it, it is
#                                           called first
set -eu
root=${1:?usage: docker/image.sh FOLDER [PROGRAMS]}
programs=${2:-}
here=$(dirname "$0")

mkdir -p "$root/usr/local/bin" "$root/usr/share/doc/tcvae" "$root/tmp" "$root/data"
if [ -n "$programs" ]; then
    cp "$programs/tcvae_node" "$programs/tcvae" "$root/usr/local/bin/"
else
    "$here/static.sh" "$root/usr/local/bin"
fi
cp "$here/../LICENSE-MIT" "$here/../LICENSE-APACHE" "$root/usr/share/doc/tcvae/"
chmod 755 "$root"/usr/local/bin/*
# Compressed recordings are unpacked there.
chmod 1777 "$root/tmp"
