"""Ideal pillars of hyperbolic lenses, off-centre, behind a stop, with glass; the same
lens as rays know it.
"""

import math

import numpy as np

from metalens.cell import Cell, Film, Index
from metalens.lens import DiameterMap, Lens
from metalens.optics import Layers, Stop
from tests.proxies import proxy_of
from tests.referees import ray_trace

WAVE, PITCH, RADIUS = 0.85, 0.42, 62.0
PROXY = proxy_of([0.0, 3 * math.pi], [1.0], (0.08, 0.32), 0.85, 1e-6)
CELL = Cell(pitch_um=PITCH, pillar=Index(3.6), substrate=Index(1.45))
CASES = {
    "plain": (ray_trace.Lens(310.0, math.inf), math.inf),
    "off-centre": (ray_trace.Lens(310.0, 1900.0, vertex=(13.0, -7.0)), 1900.0),
    "glass": (
        ray_trace.Lens(310.0, math.inf, behind=((1.51, 90.0), (1.38, 30.0))),
        math.inf,
    ),
    "stop": (
        ray_trace.Lens(
            310.0, math.inf, front=((1.45, 130.0),), stop=(35.0, 130.0, (0.0, 0.0))
        ),
        math.inf,
    ),
    "all": (
        ray_trace.Lens(
            310.0,
            1900.0,
            (9.0, 4.0),
            ((1.62, 20.0), (1.45, 90.0)),
            ((1.51, 90.0),),
            (37.0, 120.0, (0.0, 0.0)),
        ),
        1300.0,
    ),
    "beside": (
        ray_trace.Lens(
            310.0, 1900.0, front=((1.45, 110.0),), stop=(29.0, 125.0, (17.0, -6.0))
        ),
        1500.0,
    ),
}


def made(case, *, radius_um=RADIUS, scatter_rad=0.0, seed=3, turns=0):
    """The lens file's content; scatter_rad: of every pillar's phase; turns: of a vortex
    in it.
    """
    rays, _ = CASES[case]
    count = 2 * math.ceil(radius_um / PITCH)
    place = (np.arange(count) - (count - 1) / 2) * PITCH
    x, y = np.meshgrid(place, place)
    rho2 = (x - rays.vertex[0]) ** 2 + (y - rays.vertex[1]) ** 2
    path = np.sqrt(rho2 + rays.sensor_um**2)
    if math.isfinite(rays.depth_um):
        path = path + np.sqrt(rho2 + rays.depth_um**2)
    phase = -2 * np.pi / WAVE * path + turns * np.arctan2(y, x)
    phase = phase + scatter_rad * np.random.default_rng(seed).normal(size=phase.shape)
    diameter = 0.2 + 0.12 * np.mod(phase, 2 * np.pi) / (3 * np.pi)
    films = [
        tuple(Film(Index(n), t) for n, t in side) for side in (rays.front, rays.behind)
    ]
    layers = Layers(
        front=films[0], behind=films[1], stop=Stop(*rays.stop) if rays.stop else None
    )
    held = DiameterMap(np.where(np.hypot(x, y) <= radius_um, diameter, 0.0), PITCH)
    return Lens(
        held, CELL, PROXY, WAVE, rays.sensor_um, rays.depth_um, "map", layers=layers
    )
