#!/usr/bin/env python3
"""What the runner costs beside DVC and Snakemake, on equal DAGs in one run: `make bench-runner`.

Two questions are asked of each program, by turns, and the medians are compared:

* A run with nothing to do, of five stages in a chain with 1 GB in 500 files: `nerf-sr run`, `dvc repro`, `snakemake -n`.
* The plan of a sweep: a stage at each of 1,000 points below two stages that are made (DVC plans nothing below what isn't):
  `nerf-sr plan`, `dvc repro --dry`, `snakemake -n`.

Stages are one script that writes files, so that only runners differ. The table goes to out/bench-runner/table.md.
"""

import argparse
import os
import pathlib
import platform
import statistics
import subprocess
import sys
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
CHAIN = ["dataset", "prep", "train", "render", "eval"]
FILES, BYTES = 100, 2_000_000
# Stages that the sweep's points share.
SHARED = 2

# Writes files; for nerf-sr it keeps the stage contract.
STAGE = """#!/usr/bin/env python3
import json, pathlib, sys
arguments = sys.argv[1:]
if arguments[:1] == ["describe"]:
    number = lambda default: {"type": "number", "default": default}
    print(json.dumps({"name": "write", "version": "1", "code": "1", "summary": "Writes files.",
        "inputs": {"from": {"kinds": ["files"], "summary": "files", "optional": True}},
        "parameters": {"type": "object", "properties": {"files": number(%d), "bytes": number(%d), "seed": number(0)}},
        "output": {"kind": "files"}}))
    sys.exit()
given = dict(zip(arguments[::2], arguments[1::2]))
out = pathlib.Path(given["--output"])
out.mkdir(parents=True, exist_ok=True)
for number in range(%d):
    (out / f"{number}.bin").write_bytes(bytes([number]) * %d)
""" % (FILES, BYTES, FILES, BYTES)


def blocks(names):
    """nerf-sr's pipeline: a chain."""
    lines = [f"default: [{names[-1]}]", "stages:"]
    for before, name in zip([None, *names], names):
        inputs = f", inputs: {{from: {before}}}" if before else ""
        lines.append(f"  {name}: {{run: ./write{inputs}}}")
    return "\n".join(lines) + "\n"


def dvc_file(names, points=None):
    """DVC's: a chain whose last stage has as many points."""
    lines = ["stages:"]
    for before, name in zip([None, *names], names):
        swept = points is not None and name == names[-1]
        suffix = "-${item}" if swept else ""
        lines.append(f"  {name}:")
        inner = "    "
        if swept:
            lines += [f"    foreach: {list(range(1, points + 1))}", "    do:"]
            inner = "      "
        lines.append(f"{inner}cmd: ./write --output data/{name}{suffix}")
        if before:
            lines.append(f"{inner}deps: ['data/{before}']")
        lines.append(f"{inner}outs: ['data/{name}{suffix}']")
    return "\n".join(lines) + "\n"


def snakefile(names, points=None):
    """Snakemake's: likewise."""
    last = names[-1]
    wanted = f"expand('data/{last}-{{seed}}', seed=range(1, {points + 1}))" if points else f"'data/{last}'"
    lines = [f"rule all:\n    input: {wanted}\n"]
    for before, name in zip([None, *names], names):
        suffix = "-{seed}" if points and name == last else ""
        given = f"    input: 'data/{before}'\n" if before else ""
        lines.append(f"rule {name}:\n{given}    output: directory('data/{name}{suffix}')\n    shell: './write --output {{output}}'\n")
    return "\n".join(lines)


def prepare(folder, text, file):
    folder.mkdir(parents=True)
    (folder / file).write_text(text)
    (folder / "write").write_text(STAGE)
    (folder / "write").chmod(0o755)
    return folder


def call(command, folder, environment):
    begun = time.perf_counter()
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if result.returncode != 0:
        sys.exit(f"bench-runner: {' '.join(map(str, command))}: {result.stderr[-2000:]}{result.stdout[-2000:]}")
    return time.perf_counter() - begun


def by_turns(commands, rounds, environment):
    """Median seconds of each command; (name, command, folder) are called by turns, once before it counts."""
    seconds = {name: [] for name, *_ in commands}
    for number in range(rounds + 1):
        for name, command, folder in commands:
            taken = call(command, folder, environment)
            if number > 0:
                seconds[name].append(taken)
    return {name: statistics.median(taken) for name, taken in seconds.items()}


def rows(title, seconds):
    ours = next(iter(seconds.values()))
    return [f"| {title} | {name} | {1000 * taken:,.0f} ms | {taken / ours:,.0f} |" for name, taken in seconds.items()]


def version(command, environment):
    return subprocess.run([command, "--version"], env=environment, capture_output=True, text=True).stdout.split()[-1]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nerf-sr", type=pathlib.Path, default=ROOT / "target/release/nerf-sr", help="the runner")
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "out/bench-runner", help="where to work")
    parser.add_argument("--rounds", type=int, default=5, help="calls of each that count (default 5)")
    parser.add_argument("--points", type=int, default=1000, help="points of the sweep (default 1000)")
    options = parser.parse_args()
    venv = options.out / "venv"
    subprocess.run([sys.executable, "-m", "venv", venv], check=True)
    requirements = ROOT / "scripts/bench-runner-requirements.txt"
    subprocess.run([venv / "bin/pip", "install", "--quiet", "-r", requirements], check=True)
    dvc, snakemake = venv / "bin/dvc", venv / "bin/snakemake"
    environment = {**os.environ, "PATH": f"{venv}/bin:{os.environ['PATH']}", "DVC_NO_ANALYTICS": "1"}
    work = options.out / "work"
    subprocess.run(["rm", "-rf", work], check=True)

    table = ["| asked | program | median | over nerf-sr |", "| --- | --- | --- | --- |"]
    dry = [snakemake, "-n", "--quiet", "all", "--cores", "1"]
    chain = [
        ("nerf-sr run", [options.nerf_sr, "run"], prepare(work / "chain/nerf-sr", blocks(CHAIN), "pipeline.yaml")),
        ("dvc repro", [dvc, "repro"], prepare(work / "chain/dvc", dvc_file(CHAIN), "dvc.yaml")),
        ("snakemake -n", dry, prepare(work / "chain/snakemake", snakefile(CHAIN), "Snakefile")),
    ]
    call([dvc, "init", "--no-scm", "--quiet"], chain[1][2], environment)
    call([snakemake, "--cores", "1"], chain[2][2], environment)
    table += rows("a run with nothing to do, 1 GB in 500 files", by_turns(chain, options.rounds, environment))

    seeds = ",".join(map(str, range(1, options.points + 1)))
    sweep = CHAIN[:SHARED + 1]
    plan = [options.nerf_sr, "plan", "-p", f"{sweep[-1]}.seed={seeds}"]
    swept = [
        ("nerf-sr plan", plan, prepare(work / "sweep/nerf-sr", blocks(sweep), "pipeline.yaml")),
        ("dvc repro --dry", [dvc, "repro", "--dry"], prepare(work / "sweep/dvc", dvc_file(sweep, options.points), "dvc.yaml")),
        ("snakemake -n", dry, prepare(work / "sweep/snakemake", snakefile(sweep, options.points), "Snakefile")),
    ]
    made = sweep[SHARED - 1]
    call([options.nerf_sr, "run", made], swept[0][2], environment)
    call([dvc, "init", "--no-scm", "--quiet"], swept[1][2], environment)
    call([dvc, "repro", made], swept[1][2], environment)
    call([snakemake, "--cores", "1", f"data/{made}"], swept[2][2], environment)
    table += rows(f"the plan of {options.points:,} points", by_turns(swept, options.rounds, environment))

    about = (
        f"{os.cpu_count()} cores, {platform.machine()}, load {os.getloadavg()[0]:.1f}; nerf-sr {version(options.nerf_sr, environment)}, "
        f"DVC {version(dvc, environment)}, Snakemake {version(snakemake, environment)}, Python {platform.python_version()}"
    )
    text = "\n".join(table) + f"\n\n{about}\n"
    (options.out / "table.md").write_text(text)
    print(text, end="")


if __name__ == "__main__":
    main()
