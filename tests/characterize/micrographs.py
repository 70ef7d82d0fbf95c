"""Micrographs of pillars by exact chords: rims, tops, noise, drift and shade."""

import numpy as np
from scipy import ndimage

FINE = 3  # samples a pixel side, for blur and drift
STRIPS = 5  # chords a sample


def covered(rows, columns, centre, diameter, *, long=1.0, turn=0.0):
    """(rows, columns) share of each sample within an ellipse of the area of a disc, by
    the lengths of its chords.

    An ellipse A dx² + 2 B dx dy + C dy² = 1 has the chord dy = (-B dx ± sqrt(C -
    (A C - B²) dx²)) / C at a distance dx from its middle; A C - B² = 1 / (a b)².

    Args:
        rows, columns: edges of the samples, equally spaced.
        centre: (row, column) of the middle.
        diameter: of the disc of equal area.
        long: length over width. turn: of the long axis from +x to +y, rad.
    """
    a, b = diameter / 2 * np.sqrt(long), diameter / 2 / np.sqrt(long)
    cosine, sine = np.cos(turn), np.sin(turn)
    mixed = cosine * sine * (a**-2 - b**-2)
    down = (sine / a) ** 2 + (cosine / b) ** 2
    count = len(columns) - 1
    strips = columns[0] + (columns[1] - columns[0]) * (
        (np.arange(count * STRIPS) + 0.5) / STRIPS
    )
    dx = strips - centre[1]
    half = np.sqrt(np.maximum(down - (dx / a / b) ** 2, 0)) / down
    middle = centre[0] - mixed * dx / down
    ends = np.clip(rows[:, None], middle - half, middle + half)
    shares = np.diff(ends, axis=0) / (rows[1] - rows[0])
    return shares.reshape(len(rows) - 1, count, STRIPS).mean(2)


def draw_pillars(
    shape,
    places,
    diameters,
    *,
    gap=0.2,
    top=0.8,
    rim=None,
    rim_px=4.0,
    blur=1.0,
    noise=0.0,
    long=1.0,
    drift_px=0.0,
    rng=None,
):
    """(y, x) picture of pillars, blurred by a Gaussian, with white noise.

    Args:
        shape: (rows, columns).
        places: (p, 2) row and column of their middles; pixel (0, 0) is about (0, 0).
        diameters: (p,) of discs of equal area, pixels.
        gap, top, rim: levels between pillars, on them, and within ``rim_px`` of edges.
        blur, noise: standard deviations, pixels and levels.
        long: length over width, for one or all; turned at random where above 1.
        drift_px: amplitude of a slow wander of the scan along x.
        rng: of noise and turns.
    """
    picture = np.full([FINE * n for n in shape], float(gap))
    rows, columns = (np.arange(FINE * n + 1) / FINE - 0.5 for n in shape)
    longs = np.broadcast_to(long, len(diameters))
    for place, size, ratio in zip(places, diameters, longs, strict=True):
        turn = rng.uniform(0, np.pi) if ratio > 1 else 0.0
        low = np.clip(np.floor((place - size) * FINE), 0, None).astype(int)
        high = np.ceil((place + size + 1) * FINE).astype(int)
        if (high <= 0).any() or (low >= picture.shape).any():
            continue
        here = slice(low[0], high[0]), slice(low[1], high[1])
        edges = rows[low[0] : high[0] + 1], columns[low[1] : high[1] + 1]
        levels = [(size, top)]
        if rim is not None:
            levels = [(size, rim), (max(size - 2 * rim_px, 1e-3), top)]
        for across, level in levels:
            share = covered(*edges, place, across, long=ratio, turn=turn)
            picture[here] += share * (level - picture[here])
    if drift_px:
        row, column = np.indices(picture.shape)
        wander = drift_px * FINE * np.sin(5 * row / len(picture))
        picture = ndimage.map_coordinates(
            picture, [row, column - wander], order=1, mode="nearest"
        )
    picture = ndimage.gaussian_filter(picture, blur * FINE)
    picture = picture.reshape(shape[0], FINE, shape[1], FINE).mean((1, 3))
    if noise:
        picture = picture + noise * rng.standard_normal(shape)
    return picture


def draw_square(count, pitch, diameters, *, centre=(0.5, 0.5), spread=0.0, **look):
    """Picture of (count, count) pillars on a square lattice.

    Args:
        centre: (row, column) of the first pillar in its cell. spread: largest
            displacement from it, in pitches.
        look: as of :func:`draw_pillars`.
    """
    cells = np.indices((count, count)).reshape(2, -1).T + np.array(centre)
    if spread:
        cells = cells + look["rng"].uniform(-spread, spread, cells.shape)
    size = int(count * pitch)
    return draw_pillars((size, size), cells * pitch - 0.5, diameters.ravel(), **look)


def errors_px(found, diameters, pitch):
    """(p,) measured less true diameters of pixels of 1 nm, each in its own cell."""
    j, i = (np.floor((v + 0.5) / pitch).astype(int) for v in (found.row, found.column))
    return found.diameter_nm - diameters[j, i]
