"""The renderer beside a path tracer (Mitsuba 3, an extra of the project): radiance
errors beside times.
"""

import time

import numpy as np
import torch

from benchmarks import Row
from codesign.eye import population
from tests.referees import pathtraced

STATES = (1, 3, 5, 8)
SAMPLES = 512
FEW = (1, 16)
NONE = float("nan")


def rows() -> list[Row]:
    """Rows of this topic; two to five minutes."""
    states = population.states_at(torch.tensor(STATES), 1)
    made = [
        pathtraced.compare(states[k : k + 1], samples=SAMPLES)
        for k in range(len(STATES))
    ]
    against = f"{SAMPLES} paths a pixel, relative L2 without their noise"
    ours = min(one.seconds[0] for one in made)
    out = [
        Row(
            "frame 96², all but mirrored lamps",
            "renderer",
            ours,
            _mean(made, "all"),
            against,
        )
    ]
    for name in pathtraced.REGIONS:
        shown = [one for one in made if one.regions[name].any()]
        ratio = f"traced / ours {np.mean([one.ratio(name) for one in shown]):.2f}"
        out.append(
            Row(f"  {name}", "renderer", ours, _mean(shown, name), against, goal=ratio)
        )
    for samples in FEW:
        errors, seconds = [], []
        for k, one in enumerate(made):
            begin = time.perf_counter()
            image = pathtraced.trace(states[k : k + 1], samples=samples, seed=7)
            seconds.append(time.perf_counter() - begin)
            errors.append(one.error(image=image))
        label = f"path tracer, {samples} paths a pixel"
        out.append(
            Row(
                "frame 96², all but mirrored lamps",
                label,
                min(seconds),
                float(np.mean(errors)),
                against,
            )
        )
    full = min(one.seconds[1] for one in made)
    return [
        *out,
        Row(
            "frame 96²",
            f"path tracer, {SAMPLES} paths a pixel",
            full,
            NONE,
            "-",
            goal=made[0].variant,
        ),
    ]


def _mean(made: list[pathtraced.Comparison], region: str) -> float:
    return float(np.mean([one.error(region) for one in made]))
