#!/usr/bin/env bash
# Installs a CPU libtorch for tch 0.26 into .libtorch/ (425 MB; linking and running need no GPU).
#
# The files come from Python wheels, which pip downloads into .libtorch/wheels and which are checked against the sizes and hashes below.
# .libtorch/licenses gets their licences, for `make dist`.
# Safe to run again: intact wheels are kept, an interrupted download starts over, and a finished installation returns at once.
# If LIBTORCH or LIBTORCH_USE_PYTORCH=1 is set, nothing is installed.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { echo "setup-libtorch: $*" >&2; }
die() { say "$*"; exit 1; }

if [ -n "${LIBTORCH_USE_PYTORCH:-}" ]; then
  python3 -c 'import torch' 2>/dev/null || die "LIBTORCH_USE_PYTORCH is set, but python3 has no torch; run pip install torch==2.13.0, or unset LIBTORCH_USE_PYTORCH"
  say "using the libtorch of the installed PyTorch (LIBTORCH_USE_PYTORCH)"; exit 0
fi
if [ -n "${LIBTORCH:-}" ]; then
  [ -e "$LIBTORCH/lib/libtorch.so" ] || die "LIBTORCH=$LIBTORCH has no lib/libtorch.so; set LIBTORCH to an unpacked libtorch 2.13, or unset LIBTORCH"
  say "using LIBTORCH=$LIBTORCH"; exit 0
fi

home=.libtorch
done_mark=$home/complete-2.13.0
[ -e "$done_mark" ] && exit 0
[ "$(uname -sm)" = "Linux x86_64" ] || die "the recorded wheels are for Linux x86-64; set LIBTORCH to a libtorch 2.13 for $(uname -sm)"
command -v cargo >/dev/null || die "cargo is missing; install Rust 1.95 or newer (rustup)"
command -v g++ >/dev/null || die "g++ is missing; apt-get install g++"
command -v python3 >/dev/null || die "python3 is missing; apt-get install python3 python3-pip"
python3 -m pip --version >/dev/null 2>&1 || die "pip is missing; apt-get install python3-pip"
free_kb=$(df -Pk . | awk 'NR==2 {print $4}')
[ "$free_kb" -gt 2000000 ] || die "2 GB of free disk space are required in $PWD, $((free_kb / 1024)) MB are free"

# requirement | file | bytes | sha256
wheels="
torch==2.13.0|torch-2.13.0-cp311-cp311-manylinux_2_28_x86_64.whl|526574961|60fcdcb2f3876e21146cb4524ef06397d727ca9ad5f020818547e25075fe3cb7
nvidia-cuda-runtime==13.0.96|nvidia_cuda_runtime-13.0.96-py3-none-manylinux2014_x86_64.manylinux_2_17_x86_64.whl|2243632|7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548
nvidia-cuda-cupti==13.0.85|nvidia_cuda_cupti-13.0.85-py3-none-manylinux_2_25_x86_64.whl|10715597|4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8
"
mkdir -p "$home/wheels" "$home/lib"
intact() { [ -f "$1" ] && [ "$(stat -c %s "$1")" = "$2" ] && [ "$(sha256sum "$1" | cut -d' ' -f1)" = "$3" ]; }
for line in $wheels; do
  IFS='|' read -r requirement file bytes sha <<<"$line"
  if intact "$home/wheels/$file" "$bytes" "$sha"; then say "$requirement: already downloaded"; continue; fi
  rm -f "$home/wheels/$file"
  say "$requirement: downloading $((bytes / 1000000)) MB"
  # Only the wheel's C++ libraries are used, so the wheel's Python version need not be that of python3.
  python3 -m pip download --quiet --no-deps --only-binary=:all: --dest "$home/wheels" --implementation cp --python-version 3.11 \
    --abi cp311 --abi none --platform manylinux_2_28_x86_64 --platform manylinux_2_25_x86_64 --platform manylinux2014_x86_64 \
    "$requirement" || die "cannot download $requirement; check the network and run make again"
  intact "$home/wheels/$file" "$bytes" "$sha" || die "$file differs from the recorded size or hash; delete $home and run make again"
done

say "unpacking"
python3 - "$home" <<'PY'
import pathlib, shutil, sys, zipfile
home = pathlib.Path(sys.argv[1])
wanted = {
    "torch-": [("torch/lib/libtorch_cpu.so", "lib"), ("torch/lib/libc10.so", "lib"), ("torch/lib/libgomp.so.1", "lib"), ("torch/include/", "include")],
    "nvidia_cuda_runtime-": [("libcudart.so.13", "lib")],
    "nvidia_cuda_cupti-": [("libcupti.so.13", "lib")],
}
for prefix, members in wanted.items():
    wheel = next((home / "wheels").glob(prefix + "*.whl"))
    with zipfile.ZipFile(wheel) as archive:
        for info in archive.infolist():
            package, in_licences, file = info.filename.partition(".dist-info/licenses/")
            if in_licences and not info.is_dir():
                target = home / "licenses" / package / file
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(archive.read(info))
            for name, folder in members:
                if name.endswith("/"):
                    if not info.filename.startswith(name) or info.is_dir():
                        continue
                    target = home / folder / info.filename[len(name):]
                elif info.filename == name or info.filename.endswith("/" + name):
                    target = home / folder / pathlib.PurePosixPath(name).name
                else:
                    continue
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(info) as source, open(target, "wb") as out:
                    shutil.copyfileobj(source, out, 1 << 20)
PY
# tch links -ltorch, but the wheel's libtorch.so depends on CUDA; this linker script replaces that library.
echo "INPUT(-ltorch_cpu)" >"$home/lib/libtorch.so"
for file in libtorch_cpu.so libc10.so libgomp.so.1 libcudart.so.13 libcupti.so.13; do
  [ -s "$home/lib/$file" ] || die "$file not found in the wheels; delete $home and run make again"
done
rm -rf "$home/wheels"
touch "$done_mark"
say "libtorch 2.13.0 is ready in $home ($(du -sh "$home" | cut -f1))"
