"""Pictures of iris, vessels, skin and lashes, made once from a seed and sampled by the
renderer.
"""

import functools
import math

import numpy as np
from scipy import ndimage

from metalens.core.arrays import Array

SIZE = 256  # of every picture, a power of two; periodic
VARIANTS = 16  # of each kind
STEPS = 32767  # of 1 in the values, which lie in [-1, 1]
KINDS = ("iris", "vein", "skin", "fine", "lash")


@functools.lru_cache(maxsize=2)
def texture_bank(seed: int = 0) -> Array:
    """(len(KINDS) * VARIANTS, SIZE, SIZE) float32 textures in [-1, 1], in steps of 1 /
    STEPS.

    The variants of a kind are consecutive. Takes about 1 s.

    Args:
        seed: of the random generator.
    """
    makers = (_iris, _veins, _skin, _fine, _lashes)
    pictures = [
        maker(np.random.default_rng((seed, kind, variant)))
        for kind, maker in enumerate(makers)
        for variant in range(VARIANTS)
    ]
    out = (np.round(np.stack(pictures).clip(-1, 1) * STEPS) / STEPS).astype(np.float32)
    out.flags.writeable = False
    return out


@functools.lru_cache(maxsize=1)
def packed_bank() -> Array:
    """The bank as integers of 1 / STEPS, every pixel (low half of an int32) with its
    right neighbour, flat.
    """
    steps = np.round(texture_bank() * STEPS).astype(np.int32)
    out = ((steps & 0xFFFF) | (np.roll(steps, -1, axis=2) << 16)).ravel()
    out.flags.writeable = False
    return out


def periodic_noise(
    rng: np.random.Generator,
    *,
    power: float,
    stretch: float = 1.0,
    shape: tuple[int, int] = (SIZE, SIZE),
) -> Array:
    """Periodic Gaussian noise of unit deviation and spectral amplitude 1 / f^power.

    ``stretch`` times longer along y.

    Args:
        rng: of the draws. power: exponent. shape: (y, x) of the noise.
    """
    fy = np.fft.fftfreq(shape[0])[:, None] * shape[0] * stretch
    fx = np.fft.rfftfreq(shape[1])[None] * shape[1]
    frequency = np.hypot(fy, fx)
    frequency[0, 0] = np.inf
    field = np.fft.irfft2(
        np.fft.rfft2(rng.standard_normal(shape)) * frequency**-power, s=shape
    )
    return np.asarray(field / field.std())


def _iris(rng: np.random.Generator) -> Array:
    """(SIZE, SIZE) fibres, collarette, crypts and furrows of an iris, in [-1, 1].

    Drawn in polar coordinates, then sampled on the plane of the iris: pupil margin at
    radius 40 pixels, limbus at 124.
    """
    rings, turns = 96, 1024
    rho = (np.arange(rings) / (rings - 1))[:, None]
    shape = (2 * rings, turns)
    noise = periodic_noise(rng, power=0.7, stretch=rng.uniform(5, 11), shape=shape)
    fibres = np.tanh(0.9 * noise[:rings])
    clouds = periodic_noise(rng, power=1.4, stretch=2.0, shape=shape)[:rings]
    wave = 0.28 + 0.05 * np.tanh(periodic_noise(rng, power=1.2, shape=(4, turns))[:1])
    collarette = np.exp(-(((rho - wave) / 0.045) ** 2))
    furrows: Array = np.zeros((rings, turns))
    for radius in rng.uniform(0.55, 0.9, rng.integers(1, 4)):
        wobble = 0.02 * np.tanh(periodic_noise(rng, power=1.5, shape=(4, turns))[:1])
        furrows = furrows + np.exp(-(((rho - radius - wobble) / 0.016) ** 2))
    polar = (
        0.6 * fibres
        + 0.35 * clouds
        + rng.uniform(0.3, 0.9) * collarette
        - rng.uniform(0, 0.6) * furrows
    )
    for _ in range(int(rng.integers(3, 14))):
        polar -= _crypt_depth(rng, rho, turns)
    y, x = np.meshgrid(
        np.arange(SIZE) - SIZE / 2, np.arange(SIZE) - SIZE / 2, indexing="ij"
    )
    row = np.clip((np.hypot(y, x) - 40) / 84, 0, 1) * (rings - 1)
    column = (np.arctan2(y, x) / (2 * math.pi) % 1) * turns
    picture = ndimage.map_coordinates(
        np.tanh(polar), [row, column], order=1, mode="grid-wrap"
    )
    return np.asarray(picture)


def _crypt_depth(rng: np.random.Generator, rho: Array, turns: int) -> Array:
    """(rings, turns) depth of a dark lozenge with a soft border near the collarette."""
    radius, angle = rng.uniform(0.32, 0.6), rng.uniform(0, 1)
    offset = (np.arange(turns) / turns - angle + 0.5) % 1 - 0.5
    distance = np.abs((rho - radius) / rng.uniform(0.05, 0.13)) + np.abs(
        offset / rng.uniform(0.006, 0.018)
    )
    return np.asarray(rng.uniform(0.6, 1.3) / (1 + np.exp(6 * (distance - 1))))


def _veins(rng: np.random.Generator) -> Array:
    """Vessels as thin winding lines that branch, in [0, 1]."""
    canvas = np.zeros((SIZE, SIZE), np.uint8)
    for _ in range(int(rng.integers(5, 12))):
        start = np.array([rng.choice([0.0, SIZE]), rng.uniform(0, SIZE)])
        heading = (0.0 if start[0] == 0 else math.pi) + rng.normal(0, 0.5)
        _draw_vessel(
            canvas,
            rng,
            start,
            heading,
            width=rng.uniform(0.25, 0.8),
            length=int(rng.integers(40, 120)),
            depth=2,
        )
    return np.asarray(ndimage.gaussian_filter(canvas / 255.0, 0.8, mode="wrap"))


def _draw_vessel(
    canvas: Array,
    rng: np.random.Generator,
    at: Array,
    heading: float,
    *,
    width: float,
    length: int,
    depth: int,
) -> None:
    """Draw a random winding line from ``at`` with branches into ``canvas``, in place.

    heading: rad. length: in steps of 2 pixels. depth: orders of branches.
    """
    import cv2

    path = [at]
    for _ in range(length):
        heading += rng.normal(0, 0.22)
        path.append(path[-1] + 2.0 * np.array([math.cos(heading), math.sin(heading)]))
        if depth and rng.random() < 0.03:
            angle = heading + rng.choice([-0.6, 0.6])
            _draw_vessel(
                canvas,
                rng,
                path[-1],
                angle,
                width=0.7 * width,
                length=length // 2,
                depth=depth - 1,
            )
    line = np.round(np.array(path) * 16).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(
        canvas, [line], False, int(255 * min(1.0, 1.4 * width)), 1, cv2.LINE_AA, 4
    )


def _skin(rng: np.random.Generator) -> Array:
    """Blotches and shallow folds that run across."""
    return np.asarray(
        np.tanh(
            0.6 * periodic_noise(rng, power=1.4)
            + 0.5 * periodic_noise(rng, power=1.1, stretch=4.0)
        )
    )


def _fine(rng: np.random.Generator) -> Array:
    """Pores and the net of fine lines."""
    pores = periodic_noise(rng, power=0.8)
    lines = np.abs(periodic_noise(rng, power=1.1, stretch=rng.uniform(0.4, 1.6))) - 0.8
    return np.asarray(np.tanh(0.5 * pores + 0.9 * lines))


def _lashes(rng: np.random.Generator) -> Array:
    """(SIZE, SIZE) opacity of hairs in [0, 1] that grow from row 0, the margin of the
    lid.

    They bend to one side and taper; the last 8 rows are empty.
    """
    import cv2

    canvas = np.zeros((SIZE, 3 * SIZE), np.uint8)
    lean = rng.uniform(-0.25, 0.25)
    for root in np.arange(0, SIZE, rng.uniform(4.5, 8.0)) + rng.uniform(0, 3):
        root = root + rng.normal(0, 2.5)
        length = rng.uniform(60, 235)
        bend = lean + rng.normal(0, 0.3)
        along = np.linspace(0, 1, 12)
        x, y = root + SIZE + length * bend * along**2, length * along
        points = np.round(np.stack([x, y], 1) * 16).astype(np.int32)
        for k in range(11):
            width = 2 if k < 4 else 1
            cv2.line(
                canvas,
                points[k].tolist(),
                points[k + 1].tolist(),
                int(255 - 21 * k),
                width,
                cv2.LINE_AA,
                4,
            )
    wrapped = np.maximum.reduce(
        [canvas[:, k * SIZE : (k + 1) * SIZE] for k in range(3)]
    )
    wrapped[-8:] = 0
    return np.asarray(
        ndimage.gaussian_filter(wrapped / 255.0, 0.7, mode=("constant", "wrap"))
    )
