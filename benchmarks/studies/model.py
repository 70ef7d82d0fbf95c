"""What a PSF and an image owe to each part of the model: their error where it is left
out, and where it is taken.

``python -m benchmarks model``: a row a part, left out and then taken, against sums that
share no code with the engine
(``tests/referees``): plane waves of every pillar of a 1 mm lens in float64 through
every film, both polarisations, one
wavelength at a time; RCWA for pillars met at an angle; a cut of unlike pillars solved
whole; every scene point through
its own PSF. Errors are relative L2 of PSFs of sum 1 unless the row says otherwise.
"""

import functools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchmarks import Row
from benchmarks.speed.image import pillar_lens
from benchmarks.studies import neighbours as rows_of_unlike
from metalens import design, library, rcwa
from metalens.cell import Cell, Film, Index
from metalens.core.arrays import Array
from metalens.design import Focus
from metalens.design.neighbours import estimate_neighbour_coupling
from metalens.image import (
    Frames,
    Grid,
    Optics,
    SmoothWave,
    Window,
    imager,
    psfs,
    uniform_imager,
)
from metalens.lens import Lens
from metalens.optics import Layers
from metalens.psf import PsfStack, Source, View, from_lens, spectrum

PITCH, COUNT, WAVELENGTH = 0.4, 3600, 0.85
# um from the rim to a window, and its diffraction: the referee of films fades what
# falls further aside
NEAR = 540.0
NARROW, WIDE = (
    81,
    241,
)  # samples of a window, a pitch each; the wide one for steep light of a lens with coma
DEPTH = 20e3
LED = Source(850.0, 30.0)
# wavelengths of the referee's diode: rim and middle of the lens part by 0.35 waves from
# one to the next
LINES = 41
LEFT, TAKEN = "left out", "taken"
Timed = tuple[PsfStack, float]


def rows() -> Iterator[Row]:
    """Field angle, spectrum, glass, cover, polarisation, angle at the pillar,
    neighbours, radiometry, the image.
    """
    yield from field_rows()
    yield from spectrum_rows()
    yield from medium_rows()
    yield from polarised_rows()
    yield from pillar_rows()
    yield from neighbour_rows()
    yield from radiometry_rows()
    yield from image_rows()


@functools.cache
def millimetre() -> Lens:
    """Of NA 0.24: 1 mm, a source at 33 mm imaged 2 mm behind it."""
    return pillar_lens(Focus(WAVELENGTH, 2e3, 33e3), 500.0)


def referee(
    lens: Lens, count: int = COUNT, *, points: int = 1, light: Array | None = None
) -> Any:
    """Plane waves of the pillars of a lens on a lattice of ``count``, ``points`` of it
    a pitch; light: (y, x) complex
    of every site, that of the lens if None."""
    from referees.true_image import Referee

    pitch = lens.cell.pitch_um
    made = Referee(
        radius=len(lens.diameters.diameter_um) / 2 * pitch,
        distance=lens.sensor_distance_um,
        focus=lens.source_distance_um,
        design_wavelength=lens.wavelength_um,
        fine=pitch / points,
        count=count,
        looked_at=WIDE * PITCH / 2,
    )
    sites = (
        lens.transmission() * np.exp(1j * lens.phase_rad()) if light is None else light
    )
    half = len(sites) // 2
    whole = np.zeros((count, count), complex)
    first = count // 2 - half * points
    whole[
        first : first + 2 * half * points + 1 : points,
        first : first + 2 * half * points + 1 : points,
    ] = sites
    made.open, phase = np.abs(whole), np.angle(whole)
    made.lens_phase = lambda: phase
    return made


def seen(
    lens: Lens, angle: float = 0.0, *, samples: int = NARROW, **about: Any
) -> Timed:
    """PSF of a source at ``DEPTH`` in the direction of an angle along x, and seconds of
    the second call.
    """
    return looked(
        lens,
        View((DEPTH,), ((angle, 0.0),), samples * lens.cell.pitch_um, samples),
        **about,
    )


def looked(lens: Lens, view: View, **about: Any) -> Timed:
    """PSF of a view, and seconds of the second call."""
    from_lens(lens, view, **about)
    return timed(lambda: from_lens(lens, view, **about))


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What it gives, and its seconds."""
    start = time.perf_counter()
    return work(), time.perf_counter() - start


def off(found: PsfStack | Array, wanted: Array) -> float:
    """Relative L2 distance of PSFs, both of sum 1 in the window of ``found``."""
    got = (
        np.asarray(found.intensity, float)[0, 0]
        if isinstance(found, PsfStack)
        else found
    )
    middle = len(wanted) // 2 - len(got) // 2
    want = wanted[middle : middle + len(got), middle : middle + len(got)]
    want, got = want / want.sum(), got / got.sum()
    return float(np.linalg.norm(got - want) / np.linalg.norm(want))


def stated(found: PsfStack) -> float:
    """Error of a PSF by its budget, without neighbours and angle, which the referees
    leave out as well.
    """
    assert found.budget is not None
    terms = (found.budget.computed, found.budget.polarisation, found.budget.glass)
    return math.hypot(*(t for t in terms if not math.isnan(t)))


def pair(
    part: str,
    judge: str,
    without: tuple[float, float],
    with_: tuple[float, float],
    said: float,
) -> Iterator[Row]:
    """Two rows of a part: (seconds, error) left out and taken; said: the error that the
    engine states.
    """
    yield Row(part, LEFT, *without, judge, threads=torch.get_num_threads())
    yield Row(
        part,
        f"{TAKEN}, {said:.1e} stated",
        *with_,
        judge,
        threads=torch.get_num_threads(),
    )


def field_rows() -> Iterator[Row]:
    """The PSF of a field angle, and that of the axis in its place."""
    lens = millimetre()
    axis, seconds = seen(lens, samples=WIDE)
    judge = referee(lens)
    for degrees in (5, 10, 15, 20):
        angle = math.radians(degrees)
        true, took = seen(lens, angle, samples=WIDE)
        wanted = judge.flux(
            (lens.sensor_distance_um * math.tan(angle), 0.0), DEPTH, WAVELENGTH
        )
        before = (seconds, off(axis, wanted))
        after = (took, off(true, wanted))
        yield from pair(
            f"field angle of {degrees} deg",
            "plane waves, both polarisations",
            before,
            after,
            stated(true),
        )


def spectrum_rows() -> Iterator[Row]:
    """A diode of 30 nm, and its middle wavelength in its place."""
    lens = millimetre()
    um, share = spectrum.spectral_weight(LED)
    some = np.linspace(um[0], um[-1], LINES)
    weights = np.interp(some, um, share)
    judge = referee(lens)
    wanted = sum(
        w * judge.intensity((0.0, 0.0), DEPTH, c)
        for c, w in zip(some, weights / weights.sum(), strict=True)
    )
    (one, seconds), (all_, took) = seen(lens), seen(lens, spectrum=LED)
    before = (seconds, off(one, wanted))
    after = (took, off(all_, wanted))
    yield from pair(
        "spectrum of 30 nm",
        f"plane waves of {LINES} wavelengths",
        before,
        after,
        stated(all_),
    )


def medium_rows() -> Iterator[Row]:
    """Glass before the sensor of a lens that was designed without, and a medium in
    place of air.
    """
    from referees.films import Stack

    lens, n = millimetre(), 1.51
    distance = lens.sensor_distance_um
    judge = "plane waves of both polarisations through the films"
    glass = replace(lens, layers=Layers(behind=(Film(Index(n), 500.0),)))
    cast = replace(lens, cell=replace(lens.cell, cover=Index(1.5)), layers=Layers())
    for name, real, films in (
        ("500 um of glass", glass, ((1.0, distance - 500.0), (n, 500.0))),
        ("cover of 1.5", cast, ((1.5, distance),)),
    ):
        wanted = Stack(
            films, wavelength=WAVELENGTH, step=PITCH, count=COUNT + 1, near=NEAR
        ).flux(turned_light(lens, films[0][0]))
        (bare, seconds), (true, took) = seen(lens), seen(real)
        before = (seconds, off(bare, wanted))
        after = (took, off(true, wanted))
        yield from pair(name, judge, before, after, stated(true))


def turned_light(lens: Lens, index: float) -> Array:
    """(2, 2, y, x) transverse fields of both polarisations behind a lens in a medium,
    the source on the axis.
    """
    from referees.vectorial import turned

    at = lens.diameters
    x, y = at.x_um, at.y_um[:, None]
    source = np.exp(2j * np.pi / WAVELENGTH * (np.hypot(np.hypot(x, y), DEPTH) - DEPTH))
    one = lens.transmission() * np.exp(1j * lens.phase_rad()) * source
    return np.asarray(turned(x, y, index * lens.sensor_distance_um) * one)


def polarised_rows() -> Iterator[Row]:
    """Both polarisations: the flux, one scalar whose rays carry their power, and one
    that knows of neither.
    """
    fast = pillar_lens(Focus(WAVELENGTH, 15.0, 60.0), 20.0)
    for na, lens, depth, count, points in (
        (0.24, millimetre(), DEPTH, COUNT, 1),
        (0.8, fast, 50.0, 3200, 2),
    ):
        part = f"polarisation, NA {na}"
        judge = referee(lens, count, points=points)
        wanted = judge.flux((0.0, 0.0), depth, WAVELENGTH)
        view = View((depth,), window_um=NARROW * PITCH / points, samples=NARROW)
        middle = slice(count // 2 - 40, count // 2 + 41)
        plain, seconds = timed(
            lambda judge=judge, depth=depth: judge.intensity(
                (0.0, 0.0), depth, WAVELENGTH
            )
        )  # type: ignore[misc]
        against = "plane waves of both polarisations"
        yield Row(
            part,
            f"{LEFT}: |U|² of plane waves",
            seconds,
            off(plain[middle, middle], wanted),
            against,
        )
        for kind in ("scalar", "flux"):
            found, took = looked(lens, view, polarisation=kind)
            yield Row(
                part,
                f"{TAKEN} by the {kind}, {stated(found):.1e} stated",
                took,
                off(found, wanted),
                against,
            )


def pillar_rows() -> Iterator[Row]:
    """Pillars that answer light of 20 degrees as their library has it at that angle,
    and as at normal incidence.
    """
    cell, angle = library.DEFAULT_CELL, math.radians(20)
    proxies = {}
    for angles in ((0.0,), (0.0, 10.0, 20.0)):
        about = library.Sweep((WAVELENGTH,), angles, samples=60, tolerance=5e-3)
        proxies[angles] = timed(
            lambda about=about: library.proxy_of(library.sweep(cell, about))
        )  # type: ignore[misc]
    (plain, seconds), (proxy, took) = proxies[(0.0,)], proxies[(0.0, 10.0, 20.0)]
    thickest = min(plain.domain_um[1], proxy.domain_um[1])  # that both know
    focus = Focus(WAVELENGTH, 240.0, DEPTH)
    limits = design.Limits(90, max(80, 1e3 * (cell.pitch_um - thickest)))
    phase = design.phase_of(None, focus, radius_um=60.0)
    about = {
        "aperture_um": 120.3,
        "limits": limits,
        "accept_partial_turn": True,
    }  # an odd number of pillars across
    lens = design.make(phase, focus, cell=cell, proxy=proxy, **about)[0]  # type: ignore[arg-type]
    (true, _), (bare, _) = (
        seen(each, angle) for each in (lens, replace(lens, proxy=plain))
    )
    wanted = _met(lens, cell, angle)
    before = (seconds, off(bare, wanted))
    after = (took, off(true, wanted))
    yield from pair(
        "angle at the pillars, 20 deg",
        "pillars by RCWA, plane waves",
        before,
        after,
        stated(true),
    )


def _met(lens: Lens, cell: Cell, angle: float) -> Array:
    """Light of a lens whose every pillar is solved by RCWA at an angle along x, the
    mean of both polarisations.
    """
    sizes = lens.diameters.diameter_um
    known = np.unique(np.round(sizes[sizes > 0], 3))
    place = (lens.sensor_distance_um * math.tan(angle), 0.0)
    total: Any = 0.0
    for light in ("s", "p"):
        t = [
            rcwa.solve(
                cell, d, WAVELENGTH, angle_rad=angle, polarization=light, harmonics=7
            ).t
            for d in known
        ]
        sites = np.where(sizes > 0, np.interp(sizes, known, t), 0)
        total = total + referee(lens, 1350, light=sites).intensity(
            place, DEPTH, WAVELENGTH
        )
    return np.asarray(total)


def neighbour_rows() -> Iterator[Row]:
    """TiO2 of NA 0.8: power in the focus of unlike pillars over that of pillars one by
    one.
    """
    na, distance, counts = rows_of_unlike.LENSES[0]
    lens = rows_of_unlike.lens_at(distance)
    found, seconds = timed(
        lambda: estimate_neighbour_coupling(
            lens, counts=counts, harmonics=rows_of_unlike.HARMONICS
        )
    )
    cut = rows_of_unlike.solved_whole(lens, "x")
    _, after, before = rows_of_unlike.judged(
        lens, cut, rows_of_unlike.factor(lens, found, 0)
    )
    part = f"unlike neighbours, NA {na}"
    judge = "share of the power; 62 pillars solved whole"
    yield Row(part, LEFT, float("nan"), before, judge)
    yield Row(
        part, f"{TAKEN} by rows of {', '.join(map(str, counts))}", seconds, after, judge
    )


def radiometry_rows() -> Iterator[Row]:
    """Power through the aperture from a small flat source at 20 degrees over that from
    the axis: the integral of
    cos θ cos θ' / r² over the aperture."""
    lens, angle = millimetre(), math.radians(20)
    radius, middle = 500.0, DEPTH * math.tan(angle)
    r = (np.arange(200) + 0.5) / 200 * radius
    turn = 2 * np.pi * (np.arange(64) + 0.5) / 64
    x, y = r[:, None] * np.cos(turn), r[:, None] * np.sin(turn)
    shares = [
        ((DEPTH**2 / ((x - m) ** 2 + y**2 + DEPTH**2) ** 2) * r[:, None]).sum()
        for m in (0.0, middle)
    ]
    wanted = shares[1] / shares[0]
    axis, side = (seen(lens, a, samples=WIDE)[0] for a in (0.0, angle))
    within = (
        float(s.energy_um2[0, 0] * s.irradiance_per_um2[0, 0]) for s in (axis, side)
    )
    power = [
        part / (1 - s.budget.outside)
        for part, s in zip(within, (axis, side), strict=True)
    ]
    told = power[1] / power[0] * math.cos(angle)  # a flat source shines by the cosine
    judge = "share of the power; solid angles of the aperture's points"
    yield Row("radiometry at 20 deg", LEFT, float("nan"), abs(1 - wanted), judge)
    yield Row("radiometry at 20 deg", TAKEN, float("nan"), abs(told - wanted), judge)


def image_rows() -> Iterator[Row]:
    """An image of +-17 degrees in two wavelengths: one PSF a depth for all of it, and
    its own for every point.
    """
    from referees.true_image import Referee

    radius, distance, focus, step, window = 50.0, 240.0, 6000.0, 4.8, 15
    wave = SmoothWave(Focus(WAVELENGTH, distance, focus), radius)
    grid = Grid((31, 31), step, (3000.0, 9000.0), margin=window // 2, window=window)
    light, depth = scene(31 + 2 * grid.margin)
    frames = as_frames(light, depth)
    lines = ((0.838, 0.37), (0.861, 0.63))
    judge = Referee(
        radius=radius,
        distance=distance,
        focus=focus,
        design_wavelength=WAVELENGTH,
        fine=0.6,
        count=256,
    )
    m = grid.margin
    wanted = judge.image(light, depth, step=step, window=window, waves=lines)[
        m:-m, m:-m
    ]
    one, seconds = _by_one(wave, distance, grid, frames)
    made = imager(
        wave,
        grid,
        spectrum=spectrum.SpectralNodes(*np.array(lines).T, 0.0),
        tolerance=1e-2,
    )
    true, took = timed(lambda: made(frames)[0].numpy())
    before, after = (
        (s, float(np.linalg.norm(i - wanted) / np.linalg.norm(wanted)))
        for i, s in ((one, seconds), (true, took))
    )
    yield from pair(
        "image over +-17 deg, two wavelengths",
        "every scene point's own PSF",
        before,
        after,
        made.error,
    )


def _by_one(
    wave: SmoothWave, distance: float, grid: Grid, frames: Frames
) -> tuple[Array, float]:
    """The image by the axis' PSFs of the design wavelength, and its seconds."""
    depths = 1 / torch.linspace(
        1 / grid.depths_um[0], 1 / grid.depths_um[1], 12, dtype=torch.float64
    )
    axis = torch.zeros(1, 2, dtype=torch.float64)
    window = Window(grid.window, grid.step_um)
    stack = psfs(
        Optics(wave, Layers(), distance),
        axis,
        depths_um=depths,
        wavelength_um=WAVELENGTH,
        window=window,
    )[0]
    made = uniform_imager(stack, depths, grid)
    seen_, seconds = timed(lambda: made(frames))
    return seen_[0].numpy(), seconds


def scene(edge: int) -> tuple[Array, Array]:
    """(y, x) light of a 1/f texture of mean 1, and a slanted depth."""
    draw = np.random.default_rng(5)
    f = np.hypot(np.fft.fftfreq(edge)[:, None], np.fft.fftfreq(edge)) + 0.5 / edge
    rough = np.fft.ifft2(np.fft.fft2(draw.standard_normal((edge, edge))) / f).real
    down = np.linspace(0, 1, edge)[:, None]
    across = np.linspace(0, 1, edge)
    depth = 1 / (1 / 3000 + (1 / 9000 - 1 / 3000) * (0.1 + 0.5 * down + 0.3 * across))
    return np.clip(1 + 0.4 * (rough - rough.mean()) / rough.std(), 0.05, None), depth


def as_frames(light: Array, depth: Array) -> Frames:
    """One sheet alone: the far one."""
    one = torch.from_numpy(np.stack([np.zeros_like(light), light])[None])
    cover = torch.from_numpy(
        np.stack([np.zeros_like(light), np.ones_like(light)])[None]
    )
    return Frames(one, cover, torch.from_numpy(np.stack([depth, depth])[None]))
