"""A lens of 1 mm and its light at 11 depths, by the sum over every pillar."""

import time

import numpy as np

from characterize.bench import bench
from characterize.bench.bench import BenchCamera, HiddenLens
from characterize.model.forward import ForwardModel, FrameSetting
from characterize.model.parameters import KnownValue
from metalens import design
from metalens.cell.record import Cell
from metalens.lens.record import Lens
from tests.characterize import bench_lens

RESPONSE = bench_lens.RESPONSE
PIXEL_UM = 3.0
PIXELS = 32
PEAK_E = 8000.0
DEPTHS = tuple((1 / np.linspace(1 / 15e3, 1 / 28e3, 11)).tolist())
HIDDEN = bench_lens.VALUES | {
    "stage_zero_um": 120.0,
    "distance_um": 6.0,
    "background_x_e": 0.0,
}


def shoot() -> tuple[Lens, float, np.ndarray]:
    """(design, seconds that the sum over every pillar took, noise-free light of the
    bench).
    """
    focus = design.Focus(0.85, 2000.0, 20000.0)
    phase = design.phase_of(None, focus, radius_um=500.0)
    lens = design.make(
        phase,
        focus,
        aperture_um=1000.0,
        cell=Cell(pitch_um=0.4),
        proxy=bench_lens.proxy(),
    )[0]
    known = tuple(KnownValue(name, value) for name, value in HIDDEN.items())
    truth = HiddenLens(
        DEPTHS,
        peak_e=PEAK_E,
        parameter=known,
        camera=BenchCamera(pixel_um=PIXEL_UM, pixels=PIXELS),
    )
    start = time.perf_counter()
    light = bench.bench_irradiance(lens, truth, RESPONSE)
    return lens, time.perf_counter() - start, light


def model(lens: Lens) -> ForwardModel:
    """The reduced model of these captures."""
    n = len(DEPTHS)
    setting = FrameSetting(
        np.array(DEPTHS), np.zeros((n, 2)), np.ones(n), PIXEL_UM, PIXELS, PIXELS
    )
    return ForwardModel(lens, setting, RESPONSE)
