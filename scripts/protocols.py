"""What a protocol (LR width x scale) is run with. Not a program."""

# Rays of a training, and fields that share them: more where LR pictures leave more open. All else is the stages' defaults.
BUDGET = {"100x2": (32_000_000, 1), "100x4": (64_000_000, 4), "200x2": (80_000_000, 1), "200x4": (70_000_000, 1)}
# Photographs in NDC: every ray ends on something and meets more samples than before white.
BUDGET |= {"252x2": (15_000_000, 1), "252x4": (15_000_000, 1)}
OTHER_BUDGET = (60_000_000, 1)
# `kernel` takes about a twelfth more time for a ray than `average`, which therefore gets as many more rays: equal times.
AVERAGE_RAYS = 13 / 12
# The field that a refiner rehearses with gets as many rays for an LR pixel, and no fewer than these.
REHEARSAL_RAYS = 2_000_000


def settings(protocol: str, supervision: str, refined: bool) -> dict:
    """The pipeline's parameters for a cell."""
    lr, scale = protocol.split("x")
    rays, members = BUDGET.get(protocol, OTHER_BUDGET)
    rays = round(rays * AVERAGE_RAYS) if supervision == "average" else rays
    # Far above the trained resolution the field is smooth within a pixel, and one ray shows it all.
    sub_rays = 2 if float(scale) < 3 else 1
    chosen = {"lr": lr, "prep.scale": scale, "supervision": supervision, "rays": rays, "members": members}
    chosen["sub_rays"] = sub_rays
    if refined:
        chosen["rehearsal-field.rays"] = max(REHEARSAL_RAYS, round(rays / float(scale) ** 2))
    return chosen
