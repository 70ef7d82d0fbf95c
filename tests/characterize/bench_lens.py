"""A small lens with a hand-made proxy, and captures of it on the virtual bench; shared
by the tests beside it.
"""

import dataclasses
import functools
import math

import numpy as np

from characterize.bench import bench
from characterize.bench.bench import BenchCamera, HiddenLens
from characterize.captures.capture import Capture
from characterize.inference.asbuilt import AsBuilt
from characterize.inference.estimate import FitOptions, fit
from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.inference.multistart import SearchTask
from characterize.model import NAMES
from characterize.model.parameters import KnownValue
from metalens import design
from metalens.cell.record import Cell, Film, Index
from metalens.fabrication import Sensitivity
from metalens.lens.record import DiameterMap, Lens
from metalens.library.proxy import Proxy
from metalens.optics import Layers

DEPTHS = (380.0, 480.0, 600.0, 800.0, 1150.0)
VALUES = {
    "bias_nm": 4.0,
    "bias_x_nm": 2.0,
    "bias_y_nm": -1.5,
    "bias_r_nm": 3.0,
    "height_nm": -8.0,
    "wavelength_nm": 0.4,
    "distance_um": 2.0,
    "decentre_x_um": 0.8,
    "decentre_y_um": -0.4,
    "stage_zero_um": 9.0,
    "stage_scale": 0.004,
    "coma_x_rad": 0.2,
    "spherical_rad": 0.15,
    "astigmatism_rad": 0.1,
    "crosstalk_px": 0.25,
    "background_e": 20.0,
    "background_x_e": 3.0,
}
RESPONSE = Sensitivity(np.array([[-0.2 + 9j, 50j], [3j, 12j], [1.5j, 6j]]), 0.17)


def proxy() -> Proxy:
    """Phase from 0 to 8 rad over 90 to 260 nm, |T| about 0.9, between 830 and 870 nm."""
    phase = np.zeros((2, 4))
    phase[0, :3], phase[1, :2] = (4.0, 3.9, 0.4), (-0.2, -0.15)
    level = np.zeros((2, 4))
    level[0] = 0.88, -0.03, 0.02, 0.03
    return Proxy(phase, level, (0.09, 0.26), (0.83, 0.87), 1e-3, 1e-3)


@functools.lru_cache
def lens(strength_rad: float = 0.0) -> Lens:
    """A hyperbolic lens of 40 um, with a cubic term on top where ``strength_rad`` is
    not 0.
    """
    focus = design.Focus(0.85, 110.0, 600.0)
    shape = design.Cubic(strength_rad) if strength_rad else None
    return design.make(
        design.phase_of(shape, focus, radius_um=20.0),
        focus,
        aperture_um=40.0,
        cell=Cell(pitch_um=0.4),
        proxy=proxy(),
    )[0]


# Σ t / n from the pillars is 70 um less than the distance
GLASS = Layers(behind=(Film(Index(1.4), 245.0),))


def row(radius_um: float = 20.0, **more: object) -> Lens:
    """One row of equal pillars from rim to rim, for what asks a lens for its radius,
    distances and films alone.
    """
    n = round(radius_um / 0.2) + 1
    across = DiameterMap(np.full((1, n), 0.2), 2 * radius_um / (n - 1))
    usual = {
        "diameters": across,
        "cell": Cell(across.pitch_um),
        "proxy": proxy(),
        "wavelength_um": 0.85,
    }
    usual |= {
        "sensor_distance_um": 110.0,
        "source_distance_um": 600.0,
        "profile": "hyperbolic",
    }
    return Lens(**(usual | more))


def truth(peak_e: float = 6000.0, seed: int = 0, **more: float) -> HiddenLens:
    """The hidden lens and its bench."""
    known = tuple(KnownValue(name, value) for name, value in (VALUES | more).items())
    return HiddenLens(
        DEPTHS,
        peak_e=peak_e,
        parameter=known,
        camera=BenchCamera(pixel_um=1.5, pixels=16),
        seed=seed,
    )


@functools.lru_cache
def light(strength_rad: float = 0.0, **more: float) -> np.ndarray:
    """Noise-free light of the bench, in units of its own."""
    return bench.bench_irradiance(lens(strength_rad), truth(**more), RESPONSE)


def counts(
    electrons: np.ndarray,
    *,
    seed: int = 0,
    read_noise_e: float = 2.0,
    full_well: float = math.inf,
) -> np.ndarray:
    """(n, y, x) counts of 12 bits of expected electrons: shot and read noise, 2 e a
    count, offset 64.
    """
    random = np.random.default_rng(seed)
    seen = np.minimum(
        random.poisson(np.maximum(electrons, 0))
        + random.normal(0, read_noise_e, electrons.shape),
        full_well,
    )
    return np.clip(np.round(seen / 2.0 + 64), 0, 4095).astype(np.uint16)


def capture(
    electrons: np.ndarray,
    *,
    seed: int = 0,
    read_noise_e: float = 2.0,
    full_well: float = math.inf,
) -> Capture:
    """Noise on expected electrons, read out at 2 e a count with stated gain and offset."""
    read = counts(electrons, seed=seed, read_noise_e=read_noise_e, full_well=full_well)
    n = len(read)
    return Capture(
        read,
        np.array(DEPTHS),
        np.zeros((n, 2)),
        np.full(n, np.nan),
        tuple(f"frame {i}" for i in range(n)),
        12,
        pixel_um=1.5,
        wavelength_um=0.85,
        about={"gain_e": 2.0, "offset": 64, "read_noise_e": read_noise_e},
    )


def electrons(
    peak_e: float = 6000.0, strength_rad: float = 0.0, **more: float
) -> np.ndarray:
    """Expected electrons of the hidden lens."""
    bright = light(strength_rad, **more)
    return bright * (peak_e / bright.max()) + bench.background_plane(truth(**more))


@dataclasses.dataclass(frozen=True, eq=False)
class Given(SearchTask):
    """A task whose parameters and what is known of them are given, not those of a lens."""

    names: tuple[str, ...] = ()
    prior: GaussianPrior | None = None


def given(
    model: object,
    frames: np.ndarray,
    noise: float,
    names: tuple[str, ...],
    prior: GaussianPrior,
) -> Given:
    """Frames with the same noise in every pixel, and a stand-in for the model."""
    everywhere = np.ones(frames.shape, bool)
    data = FitImages(
        frames,
        everywhere,
        ~everywhere,
        np.full(frames.shape, noise**2),
        np.full(frames.shape, 1e15),
    )
    return Given(model, data, np.zeros(len(NAMES)), {}, names=names, prior=prior)


def with_a_moved_frame(shots: Capture) -> Capture:
    """The capture with one frame a pixel off."""
    frames = shots.frames.copy()
    frames[2] = np.roll(frames[2], 1, 1)
    return dataclasses.replace(shots, frames=frames)


def found_again(made: Lens) -> tuple[AsBuilt, dict[str, float], dict[str, float]]:
    """The fit of a lens to frames of the hidden one by the engine that designs; what it
    is off in standard deviations
    of the model, and these, by name."""
    hidden = truth(peak_e=6000.0)
    light = bench.bench_irradiance(made, hidden, RESPONSE)
    frames = capture(light * (6000.0 / light.max()) + bench.background_plane(hidden))
    found = fit(
        frames,
        made,
        FitOptions(scan_um=60.0),
        response=dataclasses.replace(RESPONSE, error=0.08),
    )
    names = [
        name
        for name in found.names
        if name in VALUES and not name.startswith("background")
    ]
    places = [found.names.index(name) for name in names]
    sigma = {
        name: float(np.sqrt(found.within_covariance[i, i]))
        for name, i in zip(names, places, strict=True)
    }
    off = {
        name: (found.value[i] - VALUES[name]) / sigma[name]
        for name, i in zip(names, places, strict=True)
    }
    return found, off, sigma
