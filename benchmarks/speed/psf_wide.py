"""PSF engine on windows as wide as a sensor: time, memory and error beside the
textbook, 1 mm lens, 21 depths.

The last row of a window counts operations: what the textbook's transforms take, and
what three transforms of the
window's own samples take for every depth field that 21 depths need. Their ratio is what
arithmetic leaves to win, since
samples of the field can be no farther apart than Nyquist's step and the engine's own
are.
"""

import math
import time
from collections.abc import Iterator

import torch

from benchmarks import Row, fastest
from benchmarks.peers.angular_spectrum import free_space_transfer
from benchmarks.speed._psf_case import (
    DEPTHS,
    GEOMETRY,
    WINDOW,
    error,
    forward,
    lens,
    peak_mb,
    textbook,
)
from metalens import propagate

FIELDS = 14  # depth fields, about
WINDOWS = (
    (384.0, 512, 100),
    (1000.0, 1280, 30),
)  # um, samples, times the textbook that are asked for
PADDED = 5000  # points of the textbook's transforms along an axis


def rows() -> Iterator[Row]:
    """Windows of 384 um and 1 mm; samples are 0.75 and 0.78 um apart."""
    maps, threads = lens("free-form"), torch.get_num_threads()
    case = propagate.make_case(
        maps[0].shape, **GEOMETRY, depths_um=DEPTHS[10], **WINDOW
    )
    h = torch.tensor(free_space_transfer(case, (PADDED, PADDED)).astype("c8"))
    slow = fastest(lambda: textbook(maps, h, grad=False), repeats=1) * len(DEPTHS)
    yield Row(
        "1 mm free-form, 21 depths",
        "textbook angular spectrum, complex64",
        slow,
        math.nan,
        "none",
        threads,
    )
    forward(
        maps, window_um=300.0, samples=400, integrate=False, depths_um=DEPTHS[:2]
    )  # compiled code is read
    for width, samples, goal in WINDOWS:
        about = {"window_um": width, "samples": samples, "integrate": False}
        start = time.perf_counter()
        stack = forward(maps, **about)
        first = time.perf_counter() - start
        wrong = error(stack, maps)
        name = f"1 mm free-form, 21 depths, {width:g} um window"
        against = f"exact sum (estimate {stack.error:.1e})"
        del stack
        yield Row(
            name,
            "windowed 1e-4, first call of the geometry",
            first,
            wrong,
            against,
            threads,
        )
        seconds = fastest(lambda a=about: forward(maps, **a), repeats=2)  # type: ignore[misc]
        memory = peak_mb(lambda a=about: forward(maps, **a))  # type: ignore[misc]
        said = f"{slow / seconds:.1f}x textbook ({goal}x); {_least(samples)}"
        yield Row(name, "windowed 1e-4", seconds, wrong, against, threads, memory, said)


def _least(samples: int) -> str:
    """Operations of the textbook over those of three transforms of a window, in words."""
    theirs = 2 * len(DEPTHS) * _operations(PADDED)
    ours = 3 * FIELDS * _operations(samples)
    counted = f"{ours / 1e9:.1f} of {theirs / 1e9:.0f} Gflop, {theirs / ours:.0f}x"
    return f"500 MB; three transforms of its samples a depth field take {counted}"


def _operations(points: int) -> float:
    """Of a complex transform of points x points."""
    return 5 * points**2 * math.log2(points**2)
