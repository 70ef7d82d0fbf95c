"""A virtual bench: frames of a hidden as-built lens by the sum over every pillar, with
the noise of a real sensor.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage, signal

from characterize.model import (
    LIGHT,
    PLACE,
    FilmStack,
    KnownValue,
    SpectralLine,
    as_built,
    extra_path,
    incidence_rad,
    light_maps,
    parameter_vector,
)
from metalens import psf
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.fabrication import Sensitivity
from metalens.lens import Lens

FINE = 9
_SPECTRUM = 1e-5  # relative error of the mean over the spectrum: 1/50 of the fit's
_MARGIN = 4  # pixels about the window whose light is blurred into it
_BLOCK_SAMPLES = 1_000_000  # fine samples of the frames in one computation


@dataclass(frozen=True, slots=True)
class BenchCamera:
    """Sensor of the virtual bench; read noise in electrons, gain in electrons a count,
    offset in counts.

    pixel_um: pitch of the pixels. pixels: along a side of a frame. bits: of the
    converter. gain_e: electrons a count.
    read_noise_e: electrons, root-mean-square. offset: counts without light. hot_share:
    share of hot pixels.
    """

    pixel_um: float = field(default=3.0, metadata={"above": 0})
    pixels: int = field(default=48, metadata={"above": 3, "most": 4096})
    bits: int = field(default=12, metadata={"above": 0, "most": 16})
    gain_e: float = field(default=2.0, metadata={"above": 0})
    read_noise_e: float = 2.0
    offset: int = field(default=64, metadata={"signed": False})
    hot_share: float = field(default=0.0, metadata={"most": 1})

    def __post_init__(self) -> None:
        if self.offset > 2**self.bits - 2:
            raise FitError(
                f"camera.offset = {self.offset}: need less than the {self.bits} bits"
            )


@dataclass(frozen=True, slots=True)
class HiddenLens:
    """A hidden as-built lens and its captures; TOML of ``metalens capture``.

    depths_um: stated source depths of the frames. angles_deg: field angles along x,
    each taken at every depth.
    peak_e: electrons in the brightest pixel. parameter: true values by name, as of
    ``characterize.model.parameters``.
    diameter_noise_nm: of every pillar by itself. dark_frames, flat_frames: how many to
    take.
    camera: of the bench. seed: of noise and of what is drawn.
    """

    depths_um: tuple[float, ...]
    angles_deg: tuple[float, ...] = (0.0,)
    peak_e: float = 8000.0
    parameter: tuple[KnownValue, ...] = ()
    camera: BenchCamera = BenchCamera()
    diameter_noise_nm: float = 0.0
    dark_frames: int = field(default=8, metadata={"above": 0})
    flat_frames: int = field(default=16, metadata={"above": 0})
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.depths_um or min(self.depths_um) <= 0 or not self.peak_e > 0:
            raise FitError(
                "need depths_um with at least one source depth above 0, and peak_e "
                "above 0"
            )

    def vector(self) -> Array:
        """True parameters; log_gain is set by ``peak_e``."""
        return parameter_vector({k.name: k.value for k in self.parameter})

    @property
    def stated(self) -> tuple[Array, Array]:
        """(n,) stated depths and (n, 2) field angles in rad of all frames."""
        angle, depth = np.meshgrid(self.angles_deg, self.depths_um, indexing="ij")
        angles = np.stack([np.radians(angle.ravel()), np.zeros(angle.size)], 1)
        return depth.ravel(), angles


@dataclass(frozen=True, eq=False, slots=True)
class SimulatedFrames:
    """Output of the bench: (n, y, x) frames, dark and flat in counts, and the frames'
    noise-free electrons, which the fit does not get.
    """

    frames: Array
    dark: Array
    flat: Array
    electrons: Array


def simulate_frames(
    lens: Lens, truth: HiddenLens, response: Sensitivity
) -> SimulatedFrames:
    """Simulated frames, dark frames and flats with noise, in counts; reproducible by
    the seed.

    Args:
        lens: the design.
        truth: the hidden lens and its captures.
        response: what height, index and sidewall do to the pillars.
    """
    generator = np.random.default_rng(truth.seed)
    light = bench_irradiance(lens, truth, response)
    electrons = light * (truth.peak_e / light.max()) + background_plane(truth)
    camera = truth.camera
    hot = generator.random(electrons.shape[1:]) < camera.hot_share
    half_well_e = 0.5 * (2**camera.bits - camera.offset) * camera.gain_e

    def even_frames(count: int, level_e: float) -> Array:
        """(count, y, x) counts of even light."""
        level = np.full(hot.shape, level_e)
        return np.stack([_read(level, camera, generator, hot) for _ in range(count)])

    frames = np.stack([_read(frame, camera, generator, hot) for frame in electrons])
    dark = even_frames(max(truth.dark_frames, 1), 0.0)
    flat = even_frames(max(truth.flat_frames, 2), half_well_e)
    return SimulatedFrames(frames, dark, flat, electrons)


def bench_irradiance(lens: Lens, truth: HiddenLens, response: Sensitivity) -> Array:
    """(n, y, x) noise-free light in the pixels without background, in arbitrary units.

    Sum over the lines of the spectrum, each by the sum over all pillars, divided by the
    square of the apparent source distance.

    Args:
        lens: the design.
        truth: the hidden lens and its captures.
        response: what height, index and sidewall do to the pillars.
    """
    x = truth.vector()
    stated, angles = truth.stated
    mean_depth = float(stated.mean())
    depth = (
        stated
        + x[PLACE["stage_zero_um"]]
        + x[PLACE["stage_scale"]] * (stated - mean_depth)
    )
    if depth.min() <= 0:
        raise FitError(
            f"true source depth {depth.min():.0f} um: stage_zero_um puts the source "
            "behind the lens"
        )
    generator = np.random.default_rng(truth.seed + 1)
    noise = generator.standard_normal(lens.diameters.diameter_um.shape)
    noise_um = noise * (truth.diameter_noise_nm * 1e-3)
    frames = np.zeros((len(depth), truth.camera.pixels, truth.camera.pixels))
    source = SpectralLine.of(lens, depth, angles, tolerance=_SPECTRUM)
    for offset_nm, weight in source.colours(x[PLACE["bandwidth_nm"]]):
        colour = x.copy()
        colour[PLACE["wavelength_nm"]] += offset_nm
        for incidence, index in _frame_groups(lens, truth, colour, depth, angles):
            transmission = as_built.as_built_transmission(
                lens,
                response,
                colour,
                noise_um=noise_um,
                angle_rad=incidence.incidence_rad,
            )
            irradiance = _irradiance(
                lens, truth, colour, transmission, incidence, depth[index]
            )
            frames[index] += weight * irradiance
    return np.asarray(
        frames
        / FilmStack.of(lens.layers, lens.wavelength_um).apparent_um(
            depth[:, None, None]
        )
        ** 2
    )


@dataclass(frozen=True, slots=True)
class _Incidence:
    """Incidence of a frame: tangents (x, y) of the source direction, shift of the
    window from the chief ray, um, and angle of incidence.
    """

    source: tuple[float, float]
    shift_um: tuple[float, float]
    incidence_rad: float


def _frame_groups(
    lens: Lens, truth: HiddenLens, x: Array, depth_um: Array, angles_rad: Array
) -> Iterator[tuple[_Incidence, list[int]]]:
    """(incidence, frame numbers) of groups of frames with equal incidence.

    A group has at most ``_BLOCK_SAMPLES`` fine samples, and one frame where light
    passes a glass plate.

    Args:
        x: (p,) true parameters.
        depth_um: (n,) true source depths.
        angles_rad: (n, 2) stated field angles.
    """
    distance = lens.sensor_distance_um + x[PLACE["distance_um"]]
    films = FilmStack.of(lens.layers, lens.wavelength_um)
    tilt, offset_um, decentre_um = (
        np.array([x[PLACE[name.format(axis)]] for axis in "xy"])
        for name in ("tilt_{}_deg", "source_{}_um", "decentre_{}_um")
    )
    chief = np.tan(angles_rad) + np.tan(np.radians(tilt))
    sources = chief - offset_um / films.apparent_um(depth_um)[:, None]
    groups: dict[_Incidence, list[int]] = {}
    for i, (ray, source) in enumerate(zip(chief, sources, strict=True)):
        crossing = [films.chief_um(distance, (x, y)) for x, y in (ray, source)]
        shift = decentre_um + np.array(crossing[0]) - np.array(crossing[1])
        incidence = _Incidence(
            (float(source[0]), float(source[1])),
            (float(shift[0]), float(shift[1])),
            incidence_rad(lens.proxy, np.arctan(source).tolist()),
        )
        groups.setdefault(incidence, []).append(i)
    samples = ((truth.camera.pixels + 2 * _MARGIN) * FINE) ** 2
    block_size = 1 if x[PLACE["glass_um"]] else max(1, _BLOCK_SAMPLES // samples)
    for incidence, index in groups.items():
        for first in range(0, len(index), block_size):
            yield incidence, index[first : first + block_size]


def _irradiance(
    lens: Lens,
    truth: HiddenLens,
    x: Array,
    transmission: Array,
    incidence: _Incidence,
    depth_um: Array,
) -> Array:
    """(n, y, x) light in the pixels at one wavelength: sum over every pillar, then
    blur, then pixels.

    Args:
        x: (p,) true parameters at this wavelength.
        transmission: (y, x) complex transmission of the pillars.
        incidence: direction of the light and shift of the window.
        depth_um: (n,) source depths.
    """
    camera = truth.camera
    distance = lens.sensor_distance_um + x[PLACE["distance_um"]]
    wavelength_um = lens.wavelength_um + x[PLACE["wavelength_nm"]] * 1e-3
    x_um, y_um = np.meshgrid(lens.diameters.x_um, lens.diameters.y_um)
    unevenness = x[[PLACE[name] for name in LIGHT]]
    if unevenness.any():
        radius = lens.diameters.radius_um
        transmission = transmission * np.exp(
            np.tensordot(unevenness, light_maps(x_um / radius, y_um / radius), 1) / 2
        )
    films = FilmStack.of(lens.layers, wavelength_um)
    image_distance = films.reduced_um(distance)
    source_distances = films.apparent_um(depth_um)
    if x[PLACE["glass_um"]]:
        path = extra_path(
            x_um,
            y_um,
            tangents=incidence.source,
            depth_um=float(source_distances[0]),
            values=x,
        )
        transmission = transmission * np.exp(2j * math.pi / wavelength_um * path)
    side = camera.pixels + 2 * _MARGIN
    stack = psf.psf_stack(
        np.angle(transmission),
        np.abs(transmission),
        **lens.diameters.grid._asdict(),
        wavelength_um=wavelength_um,
        sensor_distance_um=distance,
        depths_um=depth_um,
        angle_rad=(math.atan(incidence.source[0]), math.atan(incidence.source[1])),
        window_um=side * camera.pixel_um,
        samples=side * FINE,
        tolerance=1e-5,
        offset_um=incidence.shift_um,
        layers=lens.layers,
    )
    step_um = camera.pixel_um / FINE
    frames = []
    for light, energy, source_distance in zip(
        stack.intensity, stack.energy_um2, source_distances, strict=True
    ):
        disc_px = x[PLACE["pinhole_um"]] * image_distance / source_distance / step_um
        light = cell_means(
            _blur(light * energy, disc_px, x[PLACE["crosstalk_px"]] * FINE)
        )
        pixels = light.reshape(side, FINE, side, FINE).sum((1, 3))
        frames.append(pixels[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN])
    return np.stack(frames)


def cell_means(light: Array) -> Array:
    """Means over fine cells from samples at their middles: f + h² f'' / 24 along each
    axis, to order h⁴.

    The samples themselves would be too strong by (pi f h)² / 6 at a frequency f: 0.3 %
    of the peak for a lens of NA 0.24 on 3 um pixels.

    Args:
        light: (..., y, x) samples.
    """
    for axis in (-2, -1):
        light = ndimage.convolve1d(
            light, np.array([1, 22, 1]) / 24, axis=axis, mode="nearest"
        )
    return light


def _blur(light: Array, disc_px: float, gauss_px: float) -> Array:
    """(y, x) light convolved with a uniform disc of a diameter, then with a Gaussian of
    a standard deviation, both in samples.
    """
    if disc_px > 0.2:
        half_width = math.ceil(disc_px / 2) + 1
        offsets = (
            np.arange((2 * half_width + 1) * 8) - ((2 * half_width + 1) * 8 - 1) / 2
        ) / 8
        inside = (offsets[:, None] ** 2 + offsets**2 <= disc_px**2 / 4).astype(float)
        kernel = inside.reshape(2 * half_width + 1, 8, 2 * half_width + 1, 8).sum(
            (1, 3)
        )
        light = signal.fftconvolve(light, kernel / kernel.sum(), mode="same")
    return np.asarray(
        ndimage.gaussian_filter(light, gauss_px, truncate=6) if gauss_px > 0 else light
    )


def background_plane(truth: HiddenLens) -> Array:
    """(y, x) electrons of the background plane.

    Args:
        truth: the hidden lens and its captures.
    """
    x = truth.vector()
    camera = truth.camera
    n = camera.pixels
    coordinate = (np.arange(n) - (n - 1) / 2) / (n / 2)
    plane = (
        x[PLACE["background_e"]]
        + x[PLACE["background_x_e"]] * coordinate
        + x[PLACE["background_y_e"]] * coordinate[:, None]
    )
    return np.asarray(np.maximum(plane, 0))


def _read(
    electrons: Array, camera: BenchCamera, generator: np.random.Generator, hot: Array
) -> Array:
    """Counts of one read-out: photon noise, read noise, offset, quantisation, clipping."""
    top = 2**camera.bits - 1
    signal = generator.poisson(np.maximum(electrons, 0)) + generator.normal(
        0, camera.read_noise_e, electrons.shape
    )
    counts = np.clip(np.round(signal / camera.gain_e + camera.offset), 0, top)
    return np.asarray(np.where(hot, 0.97 * top, counts).astype(np.uint16))
