#!/usr/bin/env bash
# Installs the programs of `make build` and `make remote`: install.sh PREFIX [LIBTORCH]; `make install PREFIX=…` calls this script.
#
# PREFIX/lib/nerf-sr gets the programs and the libraries of LIBTORCH that they need; the programs' rpath searches this folder first.
# PREFIX/bin gets links. DESTDIR is prepended to PREFIX, for package builds.
set -euo pipefail
cd "$(dirname "$0")/.."

die() { echo "install: $*" >&2; exit 1; }
[ $# -ge 1 ] || die "PREFIX is missing; usage: scripts/install.sh PREFIX [LIBTORCH]"
case $1 in /*) ;; *) die "PREFIX=$1 is not absolute; give an absolute path, such as PREFIX=$PWD/$1" ;; esac
built=${BUILT:-target/release}
libtorch=$(realpath "${2:-.libtorch}")/lib
root=${DESTDIR:-}$1
home=$root/lib/nerf-sr
if [ -e "$home" ] && [ ! -e "$home/nerf-sr" ]; then die "$home exists and has no nerf-sr; choose another PREFIX"; fi

# A stage's folder, crate and binary have one name; a folder may have further binaries. nerf-sr-remote is optional, because it is built separately.
commands=(nerf-sr)
[ ! -x "$built/nerf-sr-remote" ] || commands+=(nerf-sr-remote)
programs=("${commands[@]}")
for folder in stages/*/; do
  name=$(basename "$folder")
  case $name in common | runner) ;; *) programs+=("$name") ;; esac
done
for file in stages/*/src/bin/*.rs; do programs+=("$(basename "$file" .rs)"); done
for name in "${programs[@]}"; do
  [ -x "$built/$name" ] || die "$built/$name not found; run \`make build\`"
done

# Libraries that the programs need from libtorch; others are the system's.
libraries=$(cd "$built" && LD_LIBRARY_PATH=$libtorch ldd "${programs[@]/#/./}" | awk '/=> \// {print $3}' | sort -u | xargs realpath | sort -u |
  while read -r file; do case $file in "$libtorch"/*) echo "$file" ;; esac; done)
[ -n "$libraries" ] || die "$libtorch has no library that these programs need; run \`make build\`"

rm -rf "$home"
mkdir -p "$home" "$root"/bin "$root"/share/man/man1 "$root"/share/bash-completion/completions \
  "$root"/share/zsh/site-functions "$root"/share/fish/vendor_completions.d
for name in "${programs[@]}"; do install -m 755 "$built/$name" "$home/$name"; done
while read -r file; do install -m 644 "$file" "$home/"; done <<<"$libraries"
for name in "${commands[@]}"; do
  ln -sfn "../lib/nerf-sr/$name" "$root/bin/$name"
  "$home/$name" man "$root/share/man/man1"
  "$home/$name" completions bash >"$root/share/bash-completion/completions/$name"
  "$home/$name" completions zsh >"$root/share/zsh/site-functions/_$name"
  "$home/$name" completions fish >"$root/share/fish/vendor_completions.d/$name.fish"
done
echo "installed: $root/bin/nerf-sr, with $(wc -w <<<"${programs[*]}") programs in $home"
