#!/usr/bin/env python3
"""Runs all tests, one test binary per core at a time, and lists skipped and slowest tests.

run-tests.py [FILTER] runs only tests whose names contain FILTER. End-to-end tests run the built stages, so build these first.
"""

import concurrent.futures
import json
import os
import pathlib
import subprocess
import sys
import time

SLOWEST = 3
# Package selections of `make build` and `make remote`: others would select other features and rebuild dependencies.
SELECTIONS = [["--workspace", "--exclude", "nerf-sr-remote"], ["-p", "nerf-sr-remote"]]
# Seconds of each binary in the last run; slow binaries start first.
TIMES = pathlib.Path("target/test-times.json")
# Binaries that take minutes: they start first where no last run is known, since the last one would run alone.
SLOW = ["viewer", "page", "export", "refine", "results", "photographs", "faults", "pipeline"]
# Binaries whose expectations depend on the number of processors; the others get one each, because trainings that share
# processors wait for each other's threads.
UNBOUND = ["tests::processors", "tests::scheduling", "tests::slurm"]
PROCESSORS = os.sched_getaffinity(0)


def build() -> list[tuple[str, str, str]]:
    """Builds all test binaries; returns (package and target, path, working folder) of each: unit tests, then end-to-end tests, slow ones first."""
    command = ["cargo", "test", "--release", "--lib", "--bins", "--tests", "--no-run", "--message-format=json-render-diagnostics"]
    messages = []
    for packages in SELECTIONS:
        built = subprocess.run(command + packages, stdout=subprocess.PIPE, text=True)
        if built.returncode:
            sys.exit(built.returncode)
        messages += built.stdout.splitlines()
    found = []
    for line in messages:
        message = json.loads(line)
        if message["reason"] == "compiler-artifact" and message["profile"]["test"] and message["executable"]:
            kind = message["target"]["kind"][0]
            folder = os.path.dirname(message["manifest_path"])
            package = os.path.basename(folder) if kind != "test" else "tests"
            found.append((kind == "test", f"{package}::{message['target']['name']}", message["executable"], folder))
    known = {f"tests::{name}": len(SLOW) - i for i, name in enumerate(SLOW)}
    known |= json.loads(TIMES.read_text()) if TIMES.exists() else {}
    found.sort(key=lambda entry: (entry[0], -known.get(entry[1], 0) if entry[0] else 0, entry[1]))
    return [entry[1:] for entry in found]


class Outcome:
    """Results of one binary's tests."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.passed, self.failed, self.skipped, self.times = 0, [], [], []
        self.output = ""


def run(name: str, path: str, folder: str, test_filter: list[str], free: list[int]) -> Outcome:
    """Runs a binary's tests one after the other, so that each test is timed; returns the results.

    The tests run on one processor of `free`, unless they need all.
    """
    outcome = Outcome(name)
    processor = free.pop()
    # Child processes inherit the processors of this thread.
    os.sched_setaffinity(0, PROCESSORS if name in UNBOUND else {processor})
    environment = dict(os.environ, CARGO_MANIFEST_DIR=folder)
    command = [path, "--test-threads=1", "--show-output", *test_filter]
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    line, begun, test, said_by = b"", time.monotonic(), None, ""
    while byte := process.stdout.read1(1):
        line += byte
        if line.startswith(b"test ") and line.endswith(b" ... "):
            begun, test = time.monotonic(), line[5:-5].decode()
        if byte == b"\n":
            text, line = line.decode(errors="replace"), b""
            outcome.output += text
            if test and text.startswith("test "):
                outcome.times.append((time.monotonic() - begun, f"{name}::{test}"))
                outcome.passed += text.endswith("ok\n")
                if text.endswith("FAILED\n"):
                    outcome.failed.append(f"{name}::{test}")
                test = None
            elif text.startswith("---- ") and text.endswith(" stdout ----\n"):
                said_by = text[5:-13]
            elif text.startswith("skipped: ") and said_by:
                outcome.skipped.append(f"{name}::{said_by}: {text.strip()}")
    free.append(processor)
    if process.wait() and not outcome.failed:
        outcome.failed.append(f"{name} exited with {process.returncode}" + (f" in {test}" if test else ""))
    return outcome


def main() -> int:
    test_filter = sys.argv[1:]
    outcomes = []
    free = sorted(PROCESSORS)
    with concurrent.futures.ThreadPoolExecutor(len(free)) as pool:
        runs = {pool.submit(run, name, path, folder, test_filter, free): name for name, path, folder in build()}
        for done in concurrent.futures.as_completed(runs):
            outcome = done.result()
            outcomes.append(outcome)
            seconds = sum(spent for spent, _ in outcome.times)
            if outcome.times or outcome.failed:
                failed = f", {len(outcome.failed)} FAILED" if outcome.failed else ""
                print(f"{runs[done]}: {outcome.passed} passed{failed}, {seconds:.1f} s", flush=True)
            if outcome.failed:
                print(outcome.output, flush=True)
    if not test_filter:
        TIMES.write_text(json.dumps({outcome.name: sum(spent for spent, _ in outcome.times) for outcome in outcomes}))
    times = sorted((time for outcome in outcomes for time in outcome.times), reverse=True)
    skipped = sorted(set(skip for outcome in outcomes for skip in outcome.skipped))
    failed = sorted(name for outcome in outcomes for name in outcome.failed)
    print("\nslowest:")
    for seconds, name in times[:SLOWEST]:
        print(f"  {seconds:6.1f} s  {name}")
    print("skipped:" if skipped else "skipped: none")
    for skip in skipped:
        print(f"  {skip}")
    for name in failed:
        print(f"FAILED: {name}")
    passed = sum(outcome.passed for outcome in outcomes) - len(skipped)
    print(f"{passed} passed, {len(failed)} failed, {len(skipped)} skipped")
    return 1 if failed or not passed else 0


if __name__ == "__main__":
    sys.exit(main())
