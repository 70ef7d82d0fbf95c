"""PSF engine on windows as wide as a sensor: time, memory and error beside the textbook, 1 mm lens, 21 depths."""

import math
import time
from collections.abc import Iterator

import torch

from benchmarks import Row, fastest
from benchmarks.psf import DEPTHS, GEOMETRY, WINDOW, error, forward, lens, peak_mb, textbook
from metalens import propagate
from metalens.propagate.textbook import transfer

WINDOWS = ((384.0, 512, 100), (1000.0, 1280, 30))  # um, samples, times the textbook that are asked for


def rows() -> Iterator[Row]:
    """Windows of 384 um and 1 mm; samples are 0.75 and 0.78 um apart."""
    maps, threads = lens("free-form"), torch.get_num_threads()
    case = propagate.case(maps[0].shape, **GEOMETRY, depths_um=DEPTHS[10], **WINDOW)
    h = torch.tensor(transfer(case, (5000, 5000), band_limited=False).astype("c8"))
    slow = fastest(lambda: textbook(maps, h, grad=False), repeats=2) * len(DEPTHS)
    yield Row("1 mm free-form, 21 depths", "textbook angular spectrum, complex64", slow, math.nan, "none", threads)
    for width, samples, goal in WINDOWS:
        about = {"window_um": width, "samples": samples, "integrate": False}
        start = time.perf_counter()
        stack = forward(maps, **about)
        first = time.perf_counter() - start
        wrong, name = error(stack, maps), f"1 mm free-form, 21 depths, {width:g} um window"
        against = f"exact sum (estimate {stack.error:.1e})"
        yield Row(name, "windowed 1e-4, first call of the geometry", first, wrong, against, threads)
        seconds = fastest(lambda a=about: forward(maps, **a), repeats=2)  # type: ignore[misc]
        memory = peak_mb(lambda a=about: forward(maps, **a))  # type: ignore[misc]
        said = f"{slow / seconds:.1f}x textbook ({goal}x), 500 MB"
        yield Row(name, "windowed 1e-4", seconds, wrong, against, threads, memory, said)
