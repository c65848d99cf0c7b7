#!/usr/bin/env python3
"""Creates a Blender data set whose test views are training views withheld from training.

Settings (defaults, regularisers, schedules) are chosen on withheld views, so that test views are only for reporting:

    scripts/hold-out.py ../shared/data/nerf_synthetic/lego out/held-out/lego
    nerf-sr run -i dataset=out/held-out/lego

Every EVERY-th training frame, beginning with frame EVERY / 2, becomes a test view. Images are linked, not copied.
"""

import argparse
import json
import pathlib

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("dataset", type=pathlib.Path, help="a data set in Blender's format")
parser.add_argument("out", type=pathlib.Path, help="folder to create")
parser.add_argument("--every", type=int, default=8, help="withhold every EVERY-th training view (default 8)")
options = parser.parse_args()

transforms = json.loads((options.dataset / "transforms_train.json").read_text())
frames = transforms["frames"]
options.out.mkdir(parents=True, exist_ok=True)
for name in sorted({pathlib.PurePosixPath(frame["file_path"]).parts[0] for frame in frames if "/" in frame["file_path"]} - {"."}):
    link = options.out / name
    if not link.is_symlink():
        link.symlink_to((options.dataset / name).resolve())
withheld = set(range(options.every // 2, len(frames), options.every))
for split, chosen in (
    ("train", [f for i, f in enumerate(frames) if i not in withheld]),
    ("test", [f for i, f in enumerate(frames) if i in withheld]),
):
    (options.out / f"transforms_{split}.json").write_text(json.dumps({**transforms, "frames": chosen}, indent=2))
print(f"{options.out}: {len(frames) - len(withheld)} training views, {len(withheld)} withheld")
