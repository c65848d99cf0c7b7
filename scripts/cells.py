"""What the measuring scripts share: one run of the pipeline, and its figures. Not a program."""

import json
import pathlib
import subprocess
import sys


def dataset(data: pathlib.Path, scene: str) -> pathlib.Path:
    """The folder of a scene: DATA/nerf_synthetic/SCENE, DATA/nerf_llff_data/SCENE or DATA/SCENE."""
    for folder in (data / "nerf_synthetic" / scene, data / "nerf_llff_data" / scene, data / scene):
        if folder.is_dir():
            return folder
    sys.exit(f"no scene {scene} in {data}: set DATA=DIR to a folder that has it")


def run(
    nerf_sr: str,
    page: pathlib.Path,
    scene: pathlib.Path | None,
    settings: list[str],
    weights: pathlib.Path | None = None,
) -> dict:
    """Runs the pipeline alone (so that times mean something), or takes it from the store, and reads the one row it gives.

    Without a scene the pipeline's own is taken: the demo scene.
    """
    (row,) = run_target("report", nerf_sr, page, scene, settings, weights)
    return row


def run_target(target: str, nerf_sr: str, page: pathlib.Path, scene, settings: list[str], weights, inputs: dict = {}) -> list[dict]:
    """The same of any target, a row for each of its evaluations; `inputs` are further ones, by name."""
    return [figures(row) for row in results(target, nerf_sr, page, scene, settings, weights, inputs)]


def results(target: str, nerf_sr: str, page: pathlib.Path, scene, settings: list[str], weights, inputs: dict = {}) -> list[dict]:
    """The same, as `results.json` has it."""
    command = [nerf_sr, "run", target, "-j", "1", "--out", page]
    if scene:
        command += ["-i", f"dataset={scene}"]
    if weights and weights.is_dir():
        command += ["-i", f"eval.weights={weights}"]  # refiners may take weights, too
    command += [word for name, value in inputs.items() for word in ("-i", f"{name}={value}")]
    command += [word for setting in settings for word in ("-p", setting)]
    print("==", *settings, flush=True)
    call(command)
    return json.loads((page / target / "results.json").read_text())


def call(command: list) -> None:
    """Runs a command; if it fails, so does the script."""
    done = subprocess.run([str(word) for word in command])
    if done.returncode != 0:
        sys.exit(done.returncode)


def figures(row: dict) -> dict:
    """A row's means, and the seconds of what it came through: training includes a refiner's, rendering includes refining."""
    train = row["stages"]["train-ss"]
    log = json.loads((pathlib.Path(train["folder"]) / "training.json").read_text())
    return {
        "psnr": row["mean"]["psnr"],
        "ssim": row["mean"]["ssim"],
        "lpips": row["mean"].get("lpips"),
        "train_s": seconds(row, "train-ss", "downscaled-field", "downscaled-views", "train-refine", "finetuned-field", "train-reference"),
        "render_s": seconds(row, "render-depth", "finetuned-views", "refine", "refine-reference", "upsample", "refine-sisr"),
        "refine_s": seconds(row, "refine", "refine-reference", "upsample", "refine-sisr"),
        "views": row["views"],
        "rays_per_s": log["rays"] / train["seconds"],
        "samples_per_ray": log["samples_per_ray"],
    }


def seconds(row: dict, *names: str) -> float:
    """What those of the stages took that a row, as `results.json` has it, came through."""
    return sum(row["stages"][name]["seconds"] for name in names if name in row["stages"])


def view_psnr(row: dict) -> dict[str, float]:
    """PSNR of every view, by name, of a row as `results.json` has it."""
    metrics = json.loads((pathlib.Path(row["stages"][row["stage"]]["folder"]) / "metrics.json").read_text())
    return {view["name"]: view["scores"]["psnr"] for view in metrics["views"]}


def mean(rows: list[dict]) -> dict:
    """Means of what are numbers in all rows."""
    keys = [key for key in rows[0] if all(isinstance(row[key], (int, float)) for row in rows)]
    return {key: sum(row[key] for row in rows) / len(rows) for key in keys}


def write(out: pathlib.Path, rows: list[dict]) -> None:
    """Writes rows whole or not at all."""
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(out.name + ".partial")
    partial.write_text(json.dumps(rows, indent=2) + "\n")
    partial.replace(out)
