"""Makes all golden files that tests compare with, from the real thing: python scripts/goldens

A crate's lie in its `tests/goldens/`. Pinned packages are in requirements.txt; `make goldens` installs them.
"""

import pathlib
import runpy

for name in ["images", "torch_field", "upsample", "paper_refiner"]:
    print(f"goldens: {name}", flush=True)
    runpy.run_path(str(pathlib.Path(__file__).with_name(f"{name}.py")), run_name="__main__")
