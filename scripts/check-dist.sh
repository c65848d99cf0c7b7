#!/usr/bin/env bash
# Checks an archive of `make dist`: check-dist.sh ARCHIVE [LIBTORCH]; `make check-dist` calls this script.
#
# A second archive of the same programs must have equal bytes. In a bare Debian 12 without network, the unpacked and moved programs must
# make the demo's page. debootstrap creates that Debian in target/debian-12 (once).
set -euo pipefail
cd "$(dirname "$0")/.."

die() { echo "check-dist: $*" >&2; exit 1; }
skip() { echo "skipped: 1 check of the archive: $*" >&2; exit 0; }
archive=${1:?ARCHIVE is missing; run make check-dist}
again=target/dist-again
# Neither the caller's umask nor the time may matter.
(umask 077 && scripts/dist.sh "${2:-.libtorch}" "$again" >/dev/null)
cmp "$archive" "$again/$(basename "$archive")" || die "two archives of the same programs differ"
rm -rf "$again"
echo "check-dist: a second archive has equal bytes"

PATH=$PATH:/usr/sbin:/sbin
[ "$(id -u)" = 0 ] || skip "chroot needs root"
command -v debootstrap >/dev/null || skip "no debootstrap (apt-get install debootstrap)"
unshare --net --mount --pid --fork true 2>/dev/null || skip "unshare isn't permitted"
debian=$PWD/target/debian-12
if [ ! -e "$debian/complete" ]; then
  rm -rf "$debian"
  debootstrap --variant=minbase bookworm "$debian" >target/debootstrap.log 2>&1 ||
    skip "debootstrap failed; target/debootstrap.log has the reason"
  touch "$debian/complete"
fi
rm -rf "$debian/check"
mkdir "$debian/check"
cp "$archive" "$debian/check/archive.tar.gz"

in_debian='
cd /check
if command -v cargo || command -v python3 || grep -qv -e "|" -e lo: /proc/net/dev; then echo "not bare, or a network" >&2; exit 1; fi
tar -xzf archive.tar.gz
mkdir elsewhere
mv nerf-sr-*-linux elsewhere/moved
for program in elsewhere/moved/lib/nerf-sr/*; do
  case $program in *.so*) ;; *) "$program" --version ;; esac
done
cp -r elsewhere/moved/share/nerf-sr demo
cd demo
../elsewhere/moved/bin/nerf-sr run -p demo-scene.size=64 -p demo-scene.train=12 -p demo-scene.test=2 -p train-ss.rays=200000
'
# shellcheck disable=SC2016 # the inner shell expands these
unshare --net --mount --pid --fork sh -euc 'mount -t proc proc "$1/proc"; exec chroot "$1" env -i PATH=/usr/bin:/bin sh -euc "$2"' \
  sh "$debian" "$in_debian" || die "the archive fails on a bare Debian 12"
page=$debian/check/demo/out/report/index.html
[ "$(grep -c '</html>' "$page")" = 1 ] || die "$page isn't a whole page"
rm -rf "$debian/check"
echo "check-dist: the demo's page was made on a bare Debian 12 without network"
