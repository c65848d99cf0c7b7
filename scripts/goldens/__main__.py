"""Makes the golden files that other implementations give: python scripts/goldens

They lie in `tests/goldens/` of their crate. Checkpoints for tests/checkpoint.rs lie in `tests/data/`. `make goldens` installs the packages
that requirements.txt pins.
"""

import pathlib
import runpy

for name in ["images", "torch_field", "upsample", "paper_refiner"]:
    print(f"goldens: {name}", flush=True)
    runpy.run_path(str(pathlib.Path(__file__).with_name(f"{name}.py")), run_name="__main__")
