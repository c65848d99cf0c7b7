"""What a protocol (LR width x scale) is run with. Not a program."""

# Rays of a training, and fields that share them: more where LR images leave more open. All else is the stages' defaults.
BUDGET = {"100x2": (32_000_000, 1), "100x4": (64_000_000, 4), "200x2": (80_000_000, 1), "200x4": (70_000_000, 1)}
# Photographs in NDC: every ray ends on something and meets more samples than before white.
PHOTOGRAPHS = {"252x2": (15_000_000, 1), "252x4": (17_500_000, 1)}
BUDGET |= PHOTOGRAPHS
OTHER_BUDGET = (60_000_000, 1)
# `kernel` takes about a twelfth more time for a ray than `average`, which therefore gets as many more rays: equal times.
AVERAGE_RAYS = 13 / 12
# The downscaled field, which a refiner learns from, gets as many rays for an LR pixel, and no fewer than these. Of photographs it gets half as many: shrunk once
# more they are easier to fit, and what fits them better lacks less, so that too little is learnt (docs/design/016-data-consistency.md).
DOWNSCALED_RAYS = 2_000_000


def settings(protocol: str, supervision: str, refined: bool) -> dict:
    """The pipeline's parameters for a cell."""
    lr, scale = protocol.split("x")
    rays, members = BUDGET.get(protocol, OTHER_BUDGET)
    rays = round(rays * AVERAGE_RAYS) if supervision == "average" else rays
    # Far above the trained resolution the field is smooth within a pixel, and one ray shows it all.
    samples_per_axis = 2 if float(scale) < 3 else 1
    chosen = {"lr_width": lr, "prep.scale": scale, "supervision": supervision, "rays": rays, "ensemble": members}
    chosen["render-depth.samples_per_axis"] = samples_per_axis
    if refined:
        as_many = round(rays / float(scale) ** 2)
        chosen["downscaled-field.rays"] = as_many // 2 if protocol in PHOTOGRAPHS else max(DOWNSCALED_RAYS, as_many)
    return chosen
