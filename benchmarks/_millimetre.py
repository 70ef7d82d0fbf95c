"""A lens of 1 mm and its captures at 11 depths, by the sum over every pillar."""

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from characterize.bench import bench
from characterize.bench.bench import Camera, Truth
from characterize.captures.capture import Capture
from characterize.inference.asbuilt import AsBuilt
from characterize.model.forward import ForwardModel, Setting
from characterize.model.parameters import Known
from metalens import design, profiles
from metalens.cell.record import Cell
from metalens.lens.record import Lens

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "characterize"))
import bench_lens

RESPONSE, PIXEL_UM, PIXELS, PEAK_E = bench_lens.RESPONSE, 3.0, 32, 8000.0
DEPTHS = tuple((1 / np.linspace(1 / 15e3, 1 / 28e3, 11)).tolist())
HIDDEN = bench_lens.VALUES | {"stage_zero_um": 120.0, "distance_um": 6.0, "background_x_e": 0.0}


@dataclass(frozen=True, eq=False, slots=True)
class Shots:
    """Captures, and the seconds that the sum over every pillar took."""

    capture: Capture
    seconds: float


def shoot() -> tuple[Lens, Shots, np.ndarray]:
    """(design, captures, noise-free light of the bench)."""
    focus = profiles.Focus(0.85, 2000.0, 20000.0)
    phase = design.phase_of(None, focus, radius_um=500.0)
    lens = design.make(phase, focus, aperture_um=1000.0, cell=Cell(pitch_um=0.4), proxy=bench_lens.proxy())[0]
    known = tuple(Known(name, value) for name, value in HIDDEN.items())
    truth = Truth(DEPTHS, peak_e=PEAK_E, parameter=known, camera=Camera(pixel_um=PIXEL_UM, pixels=PIXELS))
    start = time.perf_counter()
    light = bench.irradiance(lens, truth, RESPONSE)
    seconds = time.perf_counter() - start
    electrons = light * (PEAK_E / light.max()) + HIDDEN["background_e"]
    n, random = len(DEPTHS), np.random.default_rng(1)
    seen = random.poisson(electrons) + random.normal(0, 2.0, electrons.shape)
    counts = np.clip(np.round(seen / 2.0 + 64), 0, 2**14 - 1).astype(np.uint16)
    names = tuple(f"frame {i}" for i in range(n))
    about = {"gain_e": 2.0, "offset": 64, "read_noise_e": 2.0}
    where = np.array(DEPTHS), np.zeros((n, 2)), np.full(n, np.nan), names, 14, PIXEL_UM, 0.85
    return lens, Shots(Capture(counts, *where, about=about), seconds), light


def model(lens: Lens) -> ForwardModel:
    """The reduced model of these captures."""
    n = len(DEPTHS)
    setting = Setting(np.array(DEPTHS), np.zeros((n, 2)), np.ones(n), PIXEL_UM, PIXELS, PIXELS)
    return ForwardModel(lens, setting, RESPONSE)


def normalised(found: AsBuilt) -> np.ndarray:
    """Errors over sigma of every fitted parameter whose truth is known."""
    pairs = zip(found.names, found.value, found.sigma, strict=True)
    z = [(v - HIDDEN.get(name, 0.0)) / s for name, v, s in pairs if name != "log_gain"]
    return np.array([value for value in z if math.isfinite(value)])
