#!/usr/bin/env bash
# Puts a CPU libtorch that tch 0.26 links against into .libtorch/ (425 MB; no GPU needed to link or run).
#
# The parts come from Python wheels, fetched by pip into .libtorch/wheels and checked against the sizes and hashes below.
# Safe to call again: what is there and right is kept, an interrupted download starts over, a finished set-up returns at once.
# An existing LIBTORCH, or LIBTORCH_USE_PYTORCH=1, is honoured: then this does nothing.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { echo "setup-libtorch: $*" >&2; }
die() { say "$*"; exit 1; }

if [ -n "${LIBTORCH_USE_PYTORCH:-}" ]; then
  python3 -c 'import torch' 2>/dev/null || die "LIBTORCH_USE_PYTORCH is set, but python3 has no torch; pip install torch==2.13.0 or unset it"
  say "using the libtorch of the installed PyTorch (LIBTORCH_USE_PYTORCH)"; exit 0
fi
if [ -n "${LIBTORCH:-}" ]; then
  [ -e "$LIBTORCH/lib/libtorch.so" ] || die "LIBTORCH=$LIBTORCH has no lib/libtorch.so; point it at an unpacked libtorch 2.13 or unset it"
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
[ "$free_kb" -gt 2000000 ] || die "2 GB of disk are needed here, $((free_kb / 1024)) MB are free"

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
  if intact "$home/wheels/$file" "$bytes" "$sha"; then say "$requirement: already here"; continue; fi
  rm -f "$home/wheels/$file"
  say "$requirement: fetching $((bytes / 1000000)) MB"
  # The wheel is named by Python version; only its C++ libraries are used, so any Python 3 may fetch this one.
  python3 -m pip download --quiet --no-deps --only-binary=:all: --dest "$home/wheels" --implementation cp --python-version 3.11 \
    --abi cp311 --abi none --platform manylinux_2_28_x86_64 --platform manylinux_2_25_x86_64 --platform manylinux2014_x86_64 \
    "$requirement" || die "$requirement could not be fetched; check the network and run make again"
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
# tch links -ltorch; the wheel's own libtorch.so pulls in CUDA.
echo "INPUT(-ltorch_cpu)" >"$home/lib/libtorch.so"
for file in libtorch_cpu.so libc10.so libgomp.so.1 libcudart.so.13 libcupti.so.13; do
  [ -s "$home/lib/$file" ] || die "$file was not in the wheels; delete $home and run make again"
done
rm -rf "$home/wheels"
touch "$done_mark"
say "libtorch 2.13.0 is ready in $home ($(du -sh "$home" | cut -f1))"
