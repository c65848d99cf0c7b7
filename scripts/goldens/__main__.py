"""Generates the golden files from other implementations: python scripts/goldens

Golden files are written to `tests/goldens/` of each crate, checkpoints for tests/checkpoint.rs to `tests/data/`. `make goldens` first
installs the packages that requirements.txt pins.
"""

import pathlib
import runpy

for name in ["images", "torch_field", "upsample", "paper_refiner"]:
    print(f"goldens: {name}", flush=True)
    runpy.run_path(str(pathlib.Path(__file__).with_name(f"{name}.py")), run_name="__main__")
