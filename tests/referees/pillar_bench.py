"""A bench that shares nothing with the fit: pillars one by one in float64, its own
camera, faults that no fit knows.

E(X) = sum over pillars of a_j t_j exp(ik (s_j + r_j)) d / (2 pi r_j²) (1/r_j - ik),
with true distances from the source
to the pillar (through plates of glass, by Snell's law) and from the pillar to the
sensor. t_j comes from the modal
library at the pillar's own height and wavelength (``pillar_table``), never from the
proxy or its slopes. Intensity is
sampled on the lens's own pitch, so that the sum is a discrete convolution, formed by
FFT without any approximation;
write fields that are shifted are convolved one by one. Blur, crosstalk and pixels are
weights of error functions; a
source is a sum of points.
"""

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np
from scipy import fft, special

from characterize.captures.capture import Capture
from tests.referees import pillar_table

MARGIN_UM = 6.0  # around the window that blur may reach in from
ZERNIKE = {
    "astigmatism": lambda u, v: math.sqrt(6) * (u * u - v * v),
    "oblique_astigmatism": lambda u, v: math.sqrt(6) * 2 * u * v,
    "coma_x": lambda u, v: math.sqrt(8) * (3 * (u * u + v * v) - 2) * u,
    "coma_y": lambda u, v: math.sqrt(8) * (3 * (u * u + v * v) - 2) * v,
    "trefoil_x": lambda u, v: math.sqrt(8) * (u**3 - 3 * u * v * v),
    "trefoil_y": lambda u, v: math.sqrt(8) * (3 * u * u * v - v**3),
    "spherical": lambda u, v: (
        math.sqrt(5) * (6 * (u * u + v * v) ** 2 - 6 * (u * u + v * v) + 1)
    ),
}


@dataclass(frozen=True)
class Faults:
    """What a real bench adds and a plain model lacks; zeros are none.

    glass_um, glass_tilt_deg: a cover of index 1.51 between source and lens, and its
    tilt.
    stitch_nm: standard deviation of the shift of each write field of ``field_um``.
    missing: share of the pillars that are not there.
    drift_nm: wavelength from the first frame to the last. led_nm: full width at half
    maximum of the spectrum.
    vibration_px: standard deviation of the blur of every second frame. ghost: its share
    of the light, (5, -4) px off.
    pixel_error: true pixel over stated, less 1. full_well_e: where pixels saturate.
    stage_um: standard deviation of the depth of single frames. gradient: light at the
    +x rim over the axis, less 1.
    light_y, light_r: ln of the irradiance there over that at the axis: at the +y rim,
    at the rim all round.
    source_um: diameter of an evenly lit source. saddle_nm, oblique_nm: diameters x² -
    y² and 2xy over R².
    """

    glass_um: float = 0.0
    glass_tilt_deg: float = 0.0
    stitch_nm: float = 0.0
    field_um: float = 10.0
    missing: float = 0.0
    sidewall_deg: float = 0.0
    drift_nm: float = 0.0
    led_nm: float = 0.0
    vibration_px: float = 0.0
    ghost: float = 0.0
    pixel_error: float = 0.0
    full_well_e: float = math.inf
    stage_um: float = 0.0
    gradient: float = 0.0
    light_y: float = 0.0
    light_r: float = 0.0
    source_um: float = 0.0
    saddle_nm: float = 0.0
    oblique_nm: float = 0.0


@dataclass(frozen=True)
class Session:
    """Depths, camera and hidden values (names as the fit calls them) of one set of
    captures.
    """

    depths_um: tuple[float, ...]
    values: dict[str, float] = field(default_factory=dict)
    faults: Faults = Faults()
    pixel_um: float = 1.5
    pixels: int = 16
    peak_e: float = 6000.0
    gain_e: float = 3.7
    read_noise_e: float = 3.1
    bits: int = 12
    seed: int = 0

    def of(self, name):
        """A hidden value, 0 where none is set."""
        return self.values.get(name, 0.0)


@dataclass(frozen=True)
class Seen:
    """What the bench hands over, and the noise-free electrons that no fit sees."""

    capture: Capture
    electrons: np.ndarray


def shoot(lens, session):
    """Frames with noise, darks and flats."""
    rng = np.random.default_rng([session.seed, 11])
    light = irradiance(lens, session)
    electrons = light * (session.peak_e / light.max()) + _background(session)
    response = 1 + 0.007 * rng.standard_normal(electrons.shape[1:])
    fixed = 97 + 2.0 * rng.standard_normal(electrons.shape[1:])
    frames = _read(electrons * response, session, rng, fixed)
    dark = _read(np.zeros((8, *response.shape)), session, rng, fixed)
    half = 0.45 * min((2**session.bits) * session.gain_e, session.faults.full_well_e)
    flat = _read(np.full((24, *response.shape), half) * response, session, rng, fixed)
    n = len(frames)
    names = tuple(f"frame_{i}.tif" for i in range(n))
    shots = Capture(
        frames,
        np.array(session.depths_um),
        np.zeros((n, 2)),
        np.full(n, np.nan),
        names,
        session.bits,
        pixel_um=session.pixel_um,
        wavelength_um=lens.wavelength_um,
        dark=dark,
        flat=flat,
    )
    return Seen(shots, electrons)


def irradiance(lens, session, depths_um=None):
    """(n, y, x) noise-free light in the pixels, in units of its own."""
    stated = np.array(session.depths_um)
    rng = np.random.default_rng([session.seed, 5])
    asked = stated if depths_um is None else np.asarray(depths_um, float)
    depth = (
        asked
        + session.of("stage_zero_um")
        + session.of("stage_scale") * (asked - stated.mean())
    )
    depth = depth + session.faults.stage_um * rng.standard_normal(len(depth))
    pillars = _pillars(lens, session, rng)
    frames = np.zeros((len(depth), session.pixels, session.pixels))
    drift = (
        session.faults.drift_nm * np.linspace(-0.5, 0.5, len(depth))
        if len(depth) > 1
        else np.zeros(1)
    )
    for line, weight in _lines(session):
        for shift in np.unique(drift):
            some = np.flatnonzero(drift == shift)
            wave = (
                lens.wavelength_um + (session.of("wavelength_nm") + line + shift) * 1e-3
            )
            frames[some] += weight * _frames(
                lens, session, pillars, wave, depth[some], some
            )
    ghost = session.faults.ghost
    return frames + ghost * np.roll(frames, (5, -4), (1, 2)) if ghost else frames


def _lines(session):
    sigma = math.hypot(session.faults.led_nm / 2.3548, session.of("bandwidth_nm"))
    if sigma == 0:
        return [(0.0, 1.0)]
    place = np.linspace(-2.4, 2.4, 9)
    weight = np.exp(-(place**2) / 2)
    return list(zip(place * sigma, weight / weight.sum(), strict=True))


def _pillars(lens, session, rng):
    """(x, y, diameter, illumination, field shifts) on the lattice, um; illumination 0
    where there is no pillar.
    """
    faults, d = session.faults, lens.diameters.diameter_um.astype(float)
    ny, nx = d.shape
    y, x = np.meshgrid(
        (np.arange(ny) - (ny - 1) / 2), (np.arange(nx) - (nx - 1) / 2), indexing="ij"
    )
    x, y = x * lens.diameters.pitch_um, y * lens.diameters.pitch_um
    there = (d > 0) & (rng.random(d.shape) >= faults.missing)
    radius = np.hypot(x, y)[d > 0].max()
    u, v = x / radius, y / radius
    bias = (
        session.of("bias_nm")
        + session.of("bias_x_nm") * u
        + session.of("bias_y_nm") * v
    )
    bias = bias + session.of("bias_r_nm") * (u * u + v * v - 0.5)
    bias = bias + faults.saddle_nm * (u * u - v * v) + faults.oblique_nm * 2 * u * v
    phase = sum(
        session.of(f"{name}_rad") * shape(u, v) for name, shape in ZERNIKE.items()
    )
    uneven = (1 + faults.gradient * u) * np.exp(
        (faults.light_y * v + faults.light_r * (u * u + v * v)) / 2
    )
    light = there * uneven * np.exp(1j * phase)
    fields = [(slice(0, ny), slice(0, nx), 0.0, 0.0)]
    if faults.stitch_nm:
        step = max(1, round(faults.field_um / lens.diameters.pitch_um))
        starts = [(i, j) for i in range(0, ny, step) for j in range(0, nx, step)]
        shifts = 1e-3 * faults.stitch_nm * rng.standard_normal((len(starts), 2))
        fields = [
            (slice(i, i + step), slice(j, j + step), *shift)
            for (i, j), shift in zip(starts, shifts, strict=True)
        ]
    return x, y, d + bias * 1e-3, light, fields


def _transmission(lens, session, diameter_um, wave):
    """t of every pillar; a tilted wall is a stack of pillars, its phase and light the
    mean over the height of ln t.
    """
    height = lens.cell.height_um + session.of("height_nm") * 1e-3
    table = pillar_table.load()
    lean = math.tan(math.radians(session.faults.sidewall_deg))
    if lean == 0:
        return table.at(diameter_um, height, wave)
    slices = (np.arange(5) + 0.5) / 5 - 0.5
    parts = [
        table.at(diameter_um - 2 * lean * height * s, height, wave) for s in slices
    ]
    turns = np.unwrap([np.angle(part) for part in parts], axis=0)
    return np.exp(
        np.mean([np.log(np.abs(part)) for part in parts], axis=0) + 1j * turns.mean(0)
    )


def _frames(lens, session, pillars, wave, depth, index):
    x, y, diameter, light, fields = pillars
    k = 2 * math.pi / wave
    made = np.where(light != 0, _transmission(lens, session, diameter, wave), 0) * light
    sources = _sources(session)
    kernels = [_kernel(lens, session, made.shape, k, one) for one in fields]
    frames = []
    for z, i in zip(depth, index, strict=True):
        fine = 0.0
        for sx, sy in sources:
            path = _source_path(session.faults, x - sx, y - sy, z)
            lit = made * np.exp(1j * k * (path - path.min())) / z
            fine = fine + _intensity(lit, kernels, fields) / len(sources)
        frames.append(_pixels(fine, lens.diameters.pitch_um, session, int(i)))
    return np.stack(frames)


def _sources(session):
    """Points of an evenly lit disc (sunflower), or its middle alone."""
    size = session.faults.source_um or session.of("pinhole_um")
    if size == 0:
        return [(0.0, 0.0)]
    count = 37
    radius = size / 2 * np.sqrt((np.arange(count) + 0.5) / count)
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5))
    return list(zip(radius * np.cos(turn), radius * np.sin(turn), strict=True))


def _source_path(faults, x, y, z):
    """Optical path from a point at depth z to (x, y) on the lens; through a plate by
    the invariant sine along the ray.

    With lateral offset rho = (z - t) tan a + t tan b and sin a = n sin b, the path is
    (z - t) / cos a + n t / cos b.
    A tilted plate adds the difference that a plane-parallel plate makes between
    directions: n t cos b - t cos a.
    """
    t, n = faults.glass_um, 1.51
    rho = np.hypot(x, y)
    if t == 0:
        return np.sqrt(rho**2 + z * z)
    if faults.glass_tilt_deg == 0:
        sine = rho / np.hypot(rho, z)
        for _ in range(40):  # Newton's method on the offset
            a, b = np.sqrt(1 - sine**2), np.sqrt(n * n - sine**2)
            off = (z - t) * sine / a + t * sine / b - rho
            sine = sine - off / ((z - t) / a**3 + t * n * n / b**3)
        a, b = np.sqrt(1 - sine**2), np.sqrt(n * n - sine**2)
        return (z - t) / a + n * n * t / b
    tilt = math.radians(faults.glass_tilt_deg)
    r = np.sqrt(rho**2 + z * z)
    sine = np.sqrt(1 - ((x * math.sin(tilt) + z * math.cos(tilt)) / r) ** 2)
    return r + t * (np.sqrt(n * n - sine**2) - np.sqrt(1 - sine**2))


def _fine_side(session, pitch_um):
    """Intensity samples a side, odd: the window and its margin, on the lens's pitch."""
    return (
        2
        * math.ceil(
            (session.pixels / 2 * session.pixel_um * 1.05 + MARGIN_UM) / pitch_um
        )
        + 1
    )


def _kernel(lens, session, shape, k, field):
    """FFT of the kernel from the pillars of a write field to every sample, by their
    difference; side lengths.

    Samples are those of a circular convolution that no wrapped light reaches: one less
    than pillars and samples a side.
    """
    pitch = lens.diameters.pitch_um
    d = lens.sensor_distance_um + session.of("distance_um")
    side = _fine_side(session, pitch)
    *slices, dx, dy = field
    counts = [one.stop - one.start for one in slices]
    rows, columns = (
        np.arange(1 - m, side) - (side - 1) / 2 - one.start + (n - 1) / 2
        for m, one, n in zip(counts, slices, shape, strict=True)
    )
    X = columns * pitch + session.of("decentre_x_um") - dx
    Y = rows * pitch + session.of("decentre_y_um") - dy
    r = np.sqrt(X[None] ** 2 + Y[:, None] ** 2 + d * d)
    kernel = np.exp(1j * k * (r - d)) * (d / (2 * math.pi * r * r)) * (1 / r - 1j * k)
    size = tuple(fft.next_fast_len(side + m - 1) for m in counts)
    return fft.fft2(kernel, size), side, size


def _intensity(lit, kernels, fields):
    """(Y, X) |E|² on the fine samples of the sensor: the sum over all pillars, field by
    field (all are as large).
    """
    (_, side, size), total = kernels[0], 0.0
    for (spectrum, *_), (rows, columns, *_) in zip(kernels, fields, strict=True):
        total = total + spectrum * fft.fft2(lit[rows, columns], size)
    y, x = (one.stop - one.start - 1 for one in fields[0][:2])
    return np.abs(fft.ifft2(total)[y : y + side, x : x + side]) ** 2


def _pixels(fine, pitch_um, session, frame):
    """Light in the pixels: a box convolved with a Gaussian is a difference of error
    functions, along each axis.

    The axis of the lens meets pixel ((n - 1) / 2, (n - 1) / 2).
    """
    pixel = session.pixel_um * (1 + session.faults.pixel_error)
    blur = session.values.get("crosstalk_px", 0.2)
    blur = math.hypot(blur, session.faults.vibration_px * (frame % 2))
    at = (np.arange(len(fine)) - (len(fine) - 1) / 2) * pitch_um / pixel
    apart = (
        at[None] - (np.arange(session.pixels) - (session.pixels - 1) / 2)[:, None]
    ) / (math.sqrt(2) * blur)
    half = 0.5 / (math.sqrt(2) * blur)
    weight = (special.erf(apart + half) - special.erf(apart - half)) / 2
    return weight @ fine @ weight.T


def _background(session):
    edge = (np.arange(session.pixels) - (session.pixels - 1) / 2) / (session.pixels / 2)
    level = session.of("background_e") + session.of("background_x_e") * edge[None]
    return level + session.of("background_y_e") * edge[:, None]


def _read(electrons, session, rng, fixed):
    seen = rng.poisson(
        np.maximum(electrons, 0)
    ) + session.read_noise_e * rng.standard_normal(electrons.shape)
    seen = np.minimum(seen, session.faults.full_well_e)
    return np.clip(
        np.rint(seen / session.gain_e + fixed), 0, 2**session.bits - 1
    ).astype(np.uint16)


def with_faults(session, **faults):
    """The session with faults added."""
    return dataclasses.replace(
        session, faults=dataclasses.replace(session.faults, **faults)
    )
