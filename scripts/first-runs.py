#!/usr/bin/env python3
"""Measures `make demo` in clean clones of commits, one after the other: first-runs.py COMMIT… [--rounds N] [--work DIR] [--out FILE]

Clones have no `target` and no `.libtorch`; the caches of cargo and pip in the home folder are kept. A row of JSON has the seconds until
the page is written, the processor time of all processes, the longest silence, whether libtorch was downloaded, the demo's scores, and
sgemm's rate before and after the run (with NumPy).
"""

import argparse
import json
import os
import pathlib
import re
import select
import shutil
import subprocess
import sys
import time


def sgemm() -> float | None:
    """Measures a product of 1024×1024 matrices; returns the best GFLOP/s of ten, or None without NumPy."""
    try:
        import numpy
    except ImportError:
        return None
    n, best = 1024, 0.0
    a = numpy.random.default_rng(1).random((n, n), dtype=numpy.float32)
    for _ in range(10):
        begin = time.perf_counter()
        a @ a
        best = max(best, 2 * n**3 / (time.perf_counter() - begin) / 1e9)
    return round(best, 1)


def listen(process: subprocess.Popen) -> tuple[str, float]:
    """Reads a process's output until the process ends; returns the output and the longest silence in seconds."""
    words, silence, last = b"", 0.0, time.monotonic()
    while True:
        select.select([process.stdout], [], [])
        piece = os.read(process.stdout.fileno(), 1 << 16)
        now = time.monotonic()
        silence, last = max(silence, now - last), now
        if not piece:
            return words.decode(errors="replace"), silence
        words += piece


def measure(repository: pathlib.Path, commit: str, work: pathlib.Path) -> dict:
    """Runs `make demo` in a clean clone of a commit and returns its row of measurements."""
    clone = work / "clone"
    shutil.rmtree(clone, ignore_errors=True)
    subprocess.run(["git", "clone", "--quiet", repository, clone], check=True)
    subprocess.run(["git", "-C", clone, "checkout", "--quiet", commit], check=True)
    environment = {name: value for name, value in os.environ.items() if name not in ("LIBTORCH", "LD_LIBRARY_PATH", "NERF_SR_STORE")}
    before, load, begin = sgemm(), os.getloadavg()[0], time.monotonic()
    process = subprocess.Popen(["make", "demo"], cwd=clone, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    words, silence = listen(process)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.monotonic() - begin
    (work / f"{commit}.log").write_text(words)
    page = clone / "out/report/index.html"
    if status or not page.exists():
        sys.exit(f"{commit}: make demo failed; its output is in {work / f'{commit}.log'}")
    scores = re.search(r"^eval: (PSNR.*)$", words, re.MULTILINE)
    return {
        "commit": commit, "seconds": round(seconds), "processor_seconds": round(usage.ru_utime + usage.ru_stime),
        "longest_silence": round(silence, 1), "libtorch": (clone / ".libtorch").exists(), "scores": scores and scores[1],
        "sgemm_before": before, "sgemm_after": sgemm(), "load_before": round(load, 1), "load_after": round(os.getloadavg()[0], 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commits", nargs="+", help="commits to measure")
    parser.add_argument("--rounds", type=int, default=1, help="runs of each commit (default 1)")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("out/first-runs"), help="folder for clones and logs (default out/first-runs)")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out/first-runs.json"), help="JSON file to write (default out/first-runs.json)")
    arguments = parser.parse_args()
    repository = pathlib.Path(__file__).resolve().parent.parent
    arguments.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for _ in range(arguments.rounds):
        for commit in arguments.commits:
            rows.append(measure(repository, commit, arguments.work.resolve()))
            print(json.dumps(rows[-1]), flush=True)
            arguments.out.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
