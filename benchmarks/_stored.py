"""What a result file holds beside its rows, and how rows made anew compare with those
that it has.
"""

import json
import math
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import Row, fastest

SIDE, TURNS = 1024, 1_000_000


def machine() -> dict[str, Any]:
    """Python, cores, and the speed of a machine: what tells a slower machine from
    slower code.
    """
    return {
        "python": platform.python_version(),
        "cores": len(os.sched_getaffinity(0)),
        "speed": speed(),
    }


def speed() -> dict[str, float]:
    """Of three jobs that no change here can touch, in about a second: a product of
    float64 matrices of 1024², on the
    threads that numpy takes (``products_gflops``), a transform of as many complex
    numbers and a million turns of an
    empty loop, both on one (``transform_ms``, ``loop_ms``)."""
    numbers = np.random.default_rng(5).standard_normal((2, SIDE, SIDE))
    product = fastest(lambda: numbers[0] @ numbers[1])
    plane = numbers[0] + 1j * numbers[1]
    transform = fastest(lambda: np.fft.fft2(plane))
    loop = fastest(lambda: [None for _ in range(TURNS)])
    told = {
        "products_gflops": 2e-9 * SIDE**3 / product,
        "transform_ms": 1e3 * transform,
        "loop_ms": 1e3 * loop,
    }
    return {name: round(value, 1) for name, value in told.items()}


def compared(path: Path, rows: list[Row]) -> str:
    """Rows beside those of a result file, a line each: time and error over the stored
    ones.

    Rows are paired by case and method, of which there may be several, in their order.
    """
    lines = []
    stored: list[dict[str, Any]] = (
        json.loads(path.read_text(encoding="utf-8"))["rows"] if path.exists() else []
    )
    for row in rows:
        at = next(
            (
                i
                for i, old in enumerate(stored)
                if (old["case"], old["method"]) == (row.case, row.method)
            ),
            None,
        )
        if at is None:
            lines.append(f"{row.case}, {row.method}: not stored")
            continue
        old = stored.pop(at)
        times = _ratio(row.seconds, old["seconds"])
        errors = _ratio(row.error, old["error"])
        lines.append(f"{row.case}, {row.method}: time {times}, error {errors}")
    return "\n".join(
        [*lines, *(f"{old['case']}, {old['method']}: stored only" for old in stored)]
    )


def _ratio(now: float, before: float) -> str:
    if math.isnan(now) and math.isnan(before):
        return "-"
    return f"x{now / before:.3g}" if before else ("same" if now == before else "from 0")
