#!/usr/bin/env python3
"""Measures the runner's overhead against DVC and Snakemake, on equal DAGs in one run: `make bench-runner`.

Two commands of each program are measured, the programs taking turns, and medians are compared:

* A run with nothing to do: the default pipeline's graph with 1 GB in 500 files, by `nerf-sr run`, `dvc repro`, `snakemake -n`.
* The plan of a sweep: one stage with 1,000 points after two finished stages (DVC plans no stage whose dependencies are missing),
  by `nerf-sr plan`, `dvc repro --dry`, `snakemake -n`.

All stages are one script that writes files, so that only the runners differ. The table is written to out/bench-runner/table.md.
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
# Graph of the default pipeline: the stages and their inputs. The last stage is a sink.
DEFAULT = {
    "dataset": [], "prep": ["dataset"], "train": ["prep"], "render": ["train", "prep"], "eval": ["render", "prep"], "report": ["eval"]
}
# Graph of the sweep: the last stage has many points, which share the other stages.
SWEEP = {"dataset": [], "prep": ["dataset"], "train": ["prep"]}
FILES, BYTES = 100, 2_000_000
# Requirements for nerf-sr, chosen by hand: maximum seconds of each verb, and minimum speed-up over the other programs.
MAX_SECONDS, MIN_SPEED_UP = {"run": 0.025, "plan": 1.0}, 20

# Stage that writes files, by nerf-sr's stage contract. A sink writes one small page.
STAGE = """#!/usr/bin/env python3
import json, pathlib, sys
arguments = sys.argv[1:]
is_sink = pathlib.Path(sys.argv[0]).name == "show"
if arguments[:1] == ["describe"]:
    files = {"kinds": ["run" if is_sink else "files"], "summary": "files", "optional": not is_sink}
    print(json.dumps({"name": "write", "version": "1", "code": "1", "summary": "Writes files.", "sink": is_sink,
        "inputs": {"run": files} if is_sink else {"a": files, "b": files},
        "parameters": {"type": "object", "properties": {"seed": {"type": "number", "default": 0}}}, "output": {"kind": "files"}}))
    sys.exit()
given = dict(zip(arguments[::2], arguments[1::2]))
out = pathlib.Path(given["--output"])
out.mkdir(parents=True, exist_ok=True)
for number in range(1 if is_sink else %d):
    (out / f"{number}.bin").write_bytes(bytes([number]) * (10 if is_sink else %d))
""" % (FILES, BYTES)


def pipeline(graph, points=None):
    """Returns pipeline.yaml of a graph; nerf-sr gets the points on the command line, so `points` is ignored."""
    lines = [f"default: [{list(graph)[-1]}]", "stages:"]
    for name, needs in graph.items():
        is_sink = name == "report"
        inputs = ", ".join(f"{'run' if is_sink else key}: {need}" for key, need in zip("ab", needs))
        lines.append(f"  {name}: {{run: ./{'show' if is_sink else 'write'}, inputs: {{{inputs}}}}}")
    return "\n".join(lines) + "\n"


def dvc_file(graph, points=None):
    """Returns dvc.yaml of a graph; `points` is the number of points of the last stage."""
    lines = ["stages:"]
    for name, needs in graph.items():
        swept = points is not None and name == list(graph)[-1]
        suffix, inner = ("-${item}", "      ") if swept else ("", "    ")
        lines.append(f"  {name}:")
        if swept:
            lines += [f"    foreach: {list(range(1, points + 1))}", "    do:"]
        lines.append(f"{inner}cmd: ./{'show' if name == 'report' else 'write'} --output data/{name}{suffix}")
        lines += [f"{inner}deps: [{', '.join(f'data/{need}' for need in needs)}]", f"{inner}outs: ['data/{name}{suffix}']"]
    return "\n".join(lines) + "\n"


def snakefile(graph, points=None):
    """Returns the Snakefile of a graph; `points` is the number of points of the last stage."""
    last = list(graph)[-1]
    wanted = f"expand('data/{last}-{{seed}}', seed=range(1, {points + 1}))" if points else f"'data/{last}'"
    lines = [f"rule all:\n    input: {wanted}\n"]
    for name, needs in graph.items():
        suffix = "-{seed}" if points and name == last else ""
        given = ", ".join(f"'data/{need}'" for need in needs)
        program = "show" if name == "report" else "write"
        lines.append(f"rule {name}:\n    input: {given}\n    output: directory('data/{name}{suffix}')\n    shell: './{program} --output {{output}}'\n")
    return "\n".join(lines)


def prepare(folder, text, file):
    folder.mkdir(parents=True)
    (folder / file).write_text(text)
    for program in ["write", "show"]:
        (folder / program).write_text(STAGE)
        (folder / program).chmod(0o755)
    return folder


def call(command, folder, environment, expected=None):
    """Runs a command and returns its seconds. Exits if the command fails or doesn't print the text of `expected` (text, count) `count` times."""
    begun = time.perf_counter()
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    taken = time.perf_counter() - begun
    output = result.stdout + result.stderr
    if result.returncode != 0 or (expected and output.count(expected[0]) != expected[1]):
        sys.exit(f"bench-runner: {' '.join(map(str, command))}: expected {expected or 'success'}, found: {output[-2000:]}")
    return taken


def by_turns(commands, rounds, environment):
    """Returns the median seconds of each command. Commands (name, command, folder, `expected` of `call`) take turns; the first round is a warm-up."""
    seconds = {name: [] for name, *_ in commands}
    for number in range(rounds + 1):
        for name, command, folder, expected in commands:
            taken = call(command, folder, environment, expected)
            if number > 0:
                seconds[name].append(taken)
    return {name: statistics.median(taken) for name, taken in seconds.items()}


def missed(verb, seconds):
    """Yields a message for each requirement that nerf-sr misses."""
    ours, *others = seconds.values()
    if ours > MAX_SECONDS[verb]:
        yield f"nerf-sr {verb} takes {1000 * ours:.0f} ms; at most {1000 * MAX_SECONDS[verb]:.0f} ms are required"
    yield from (f"nerf-sr {verb} is {other / ours:.0f} times as fast; at least {MIN_SPEED_UP} times is required" for other in others if other < MIN_SPEED_UP * ours)


def rows(title, seconds):
    ours = next(iter(seconds.values()))
    return [f"| {title} | {name} | {1000 * taken:,.0f} ms | {taken / ours:,.0f} |" for name, taken in seconds.items()]


def version(command, environment):
    return subprocess.run([command, "--version"], env=environment, capture_output=True, text=True).stdout.split()[-1]


def absolute(path):
    return pathlib.Path(path).absolute()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    # Programs run in other folders, so paths are absolute.
    parser.add_argument("--nerf-sr", type=absolute, default=ROOT / "target/release/nerf-sr", help="runner (default target/release/nerf-sr)")
    parser.add_argument("--out", type=absolute, default=ROOT / "out/bench-runner", help="working folder (default out/bench-runner)")
    parser.add_argument("--rounds", type=int, default=5, help="measured calls of each command (default 5)")
    parser.add_argument("--points", type=int, default=1000, help="number of points of the sweep (default 1000)")
    options = parser.parse_args()
    venv = options.out / "venv"
    subprocess.run([sys.executable, "-m", "venv", venv], check=True)
    requirements = ROOT / "scripts/bench-runner-requirements.txt"
    subprocess.run([venv / "bin/pip", "install", "--quiet", "-r", requirements], check=True)
    dvc, snakemake = venv / "bin/dvc", venv / "bin/snakemake"
    environment = {**os.environ, "PATH": f"{venv}/bin:{os.environ['PATH']}", "DVC_NO_ANALYTICS": "1"}
    work = options.out / "work"
    subprocess.run(["rm", "-rf", work], check=True)

    places = {name: work / name for name in ["run/nerf-sr", "run/dvc", "run/snakemake", "plan/nerf-sr", "plan/dvc", "plan/snakemake"]}
    files = {"nerf-sr": (pipeline, "pipeline.yaml"), "dvc": (dvc_file, "dvc.yaml"), "snakemake": (snakefile, "Snakefile")}
    for name, folder in places.items():
        verb, tool = name.split("/")
        graph, points = (DEFAULT, None) if verb == "run" else (SWEEP, options.points)
        text, file = files[tool]
        prepare(folder, text(graph, points), file)
        if tool == "dvc":
            call([dvc, "init", "--no-scm", "--quiet"], folder, environment)
    dry = [snakemake, "-n", "--cores", "1"]

    run = [
        ("nerf-sr run", [options.nerf_sr, "run"], places["run/nerf-sr"], ("nothing to run", 1)),
        ("dvc repro", [dvc, "repro"], places["run/dvc"], ("didn't change, skipping", len(DEFAULT))),
        ("snakemake -n", dry, places["run/snakemake"], ("Nothing to be done", 1)),
    ]
    for command, place in [([options.nerf_sr, "run"], "nerf-sr"), ([dvc, "repro"], "dvc"), ([snakemake, "--cores", "1"], "snakemake")]:
        call(command, places[f"run/{place}"], environment)
    nothing = by_turns(run, options.rounds, environment)

    seeds = ",".join(map(str, range(1, options.points + 1)))
    plan = [
        ("nerf-sr plan", [options.nerf_sr, "plan", "-p", f"train.seed={seeds}"], places["plan/nerf-sr"], ("will run", options.points)),
        ("dvc repro --dry", [dvc, "repro", "--dry"], places["plan/dvc"], ("Running stage 'train@", options.points)),
        ("snakemake -n", dry, places["plan/snakemake"], ("rule train:", options.points)),
    ]
    # `prep` must exist: DVC plans no stage whose dependencies are missing.
    for command, place in [([options.nerf_sr, "run", "prep"], "nerf-sr"), ([dvc, "repro", "prep"], "dvc"), ([snakemake, "--cores", "1", "data/prep"], "snakemake")]:
        call(command, places[f"plan/{place}"], environment)
    sweep = by_turns(plan, options.rounds, environment)

    table = ["| asked | program | median | over nerf-sr |", "| --- | --- | --- | --- |"]
    table += rows("a run with nothing to do, 1 GB in 500 files", nothing)
    table += rows(f"the plan of {options.points:,} points", sweep)
    about = (
        f"{os.cpu_count()} cores, {platform.machine()}, load {os.getloadavg()[0]:.1f}; nerf-sr {version(options.nerf_sr, environment)}, "
        f"DVC {version(dvc, environment)}, Snakemake {version(snakemake, environment)}, Python {platform.python_version()}"
    )
    text = "\n".join(table) + f"\n\n{about}\n"
    (options.out / "table.md").write_text(text)
    print(text, end="")
    problems = [*missed("run", nothing), *missed("plan", sweep)]
    if problems:
        sys.exit("bench-runner: " + "; ".join(problems))


if __name__ == "__main__":
    main()
