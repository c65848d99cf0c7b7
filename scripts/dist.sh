#!/usr/bin/env bash
# Packs the installed programs, the demo's pipeline and all licences: dist.sh [LIBTORCH [FOLDER]]; `make dist` calls this script.
#
# FOLDER (target/dist) gets nerf-sr-VERSION-MACHINE-linux.tar.gz. Equal programs and commits give equal bytes: names are sorted, and
# owners, modes and times are fixed. The format is gzip, because a bare Debian 12 has neither xz nor zstd.
set -euo pipefail
cd "$(dirname "$0")/.."

die() { echo "dist: $*" >&2; exit 1; }
libtorch=${1:-.libtorch}
out=${2:-target/dist}
built=${BUILT:-target/release}
[ -x "$built/nerf-sr" ] || die "$built/nerf-sr not found; run \`make build remote\`"
version=$("$built/nerf-sr" --version | cut -d' ' -f2)
seconds=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)} || die "no commit found; set SOURCE_DATE_EPOCH"
name=nerf-sr-$version-$(uname -m)-linux
folder=$out/$name
archive=$folder.tar.gz

rm -rf "$folder" "$archive"
mkdir -p "$folder/share/nerf-sr" "$folder/share/doc/nerf-sr"
python3 scripts/licences.py "$folder/share/doc/nerf-sr/licences" "$libtorch"
cp LICENSE-MIT LICENSE-APACHE "$folder/share/doc/nerf-sr"
cp -r pipeline.yaml pipelines "$folder/share/nerf-sr"
scripts/install.sh "$(realpath "$folder")" "$libtorch"
glibc=$(readelf --version-info --wide "$folder"/lib/nerf-sr/* | grep -o 'GLIBC_[0-9][0-9.]*' | sort -Vu | tail -1)
cat >"$folder/README" <<END
nerf-sr $version: high-resolution novel views from low-resolution posed photographs

The programs need Linux on $(uname -m), glibc ${glibc#GLIBC_} or newer, and libstdc++; a bare Debian 12 has both. They need no network, and
this folder may be anywhere.

The demo creates a page, demo/out/report/index.html:
  cp -r $name/share/nerf-sr demo
  cd demo
  ../$name/bin/nerf-sr run

Own photographs with poses, in a folder without a pipeline.yaml:
  export PATH=PATH-OF-THIS-FOLDER/bin:\$PATH
  nerf-sr init my-photographs
  nerf-sr run

bin                          nerf-sr, and nerf-sr-remote, which shares stores between machines
lib/nerf-sr                  all programs, and libtorch
share/man                    manual pages: man -M share/man nerf-sr
share/bash-completion, zsh, fish   completions
share/nerf-sr                the demo's pipeline.yaml, and further targets
share/doc/nerf-sr            licences of nerf-sr (MIT or Apache-2.0); in licences, those of linked crates, Rust and libtorch
END

LC_ALL=C tar --sort=name --format=gnu --mtime="@$seconds" --owner=0 --group=0 --numeric-owner --mode=u+rw,go-w,a+rX \
  -C "$out" -cf - "$name" | gzip -n >"$archive.partial"
mv "$archive.partial" "$archive"
rm -rf "$folder"
echo "$archive: $(($(stat -c %s "$archive") / 1000000)) MB"
