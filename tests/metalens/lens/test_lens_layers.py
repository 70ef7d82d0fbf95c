"""Films on the lens: kept in its file, corrected for by the design, seen by the focus
check and the PSF.
"""

from dataclasses import replace

import numpy as np
import pytest

from metalens import design, lens, psf
from metalens.cell.record import Cell, Film, Index
from metalens.core.errors import LensError, PropagationError
from metalens.design import Focus, check_focus
from metalens.optics import Layers, Stop
from tests.proxies import proxy_of

CELL = Cell(pitch_um=0.35, pillar=Index(3.6), substrate=Index(1.45), cover=Index(1.21))
GLASS = Film(Index(1.52), 60.0)
LAYERS = Layers(
    front=(Film(Index(1.45), 150.0),),
    behind=(GLASS, Film(Index(1.9), 9.0)),
    cover=CELL.cover,
)
FOCUS = Focus(0.85, 200.0, 2000.0, LAYERS)


@pytest.fixture(scope="module")
def proxy():
    """A transparent pillar of 1.4 turns over 80-290 nm."""
    return proxy_of([0.0, 4.5], [0.95], (0.08, 0.29), 0.85)


def made(proxy, focus=FOCUS, cell=CELL):
    phase = design.phase_of(None, focus, radius_um=40.0)
    return design.make(phase, focus, aperture_um=80.0, cell=cell, proxy=proxy)


def test_a_design_corrected_for_its_films_focuses_to_the_diffraction_limit(proxy):
    one, quality = made(proxy)
    found = check_focus(one)
    assert found.passed
    assert found.figures.strehl == pytest.approx(1.0, abs=1e-3)  # of the PSF
    # the ray through the rim obeys Snell's law in every medium: reach = sum t tan
    angles = [np.arcsin(quality.numerical_aperture / n) for n in (1.21, 1.52, 1.9)]
    assert sum(
        t * np.tan(a) for t, a in zip((131.0, 60.0, 9.0), angles, strict=True)
    ) == pytest.approx(40.0, rel=1e-9)


def test_a_design_that_forgets_glass_or_cover_is_told_that_it_does_not_focus(proxy):
    air = Focus(0.85, 200.0, 2000.0)
    forgotten = replace(
        made(proxy, air, replace(CELL, cover="air"))[0], layers=Layers(behind=(GLASS,))
    )
    assert not check_focus(forgotten).passed
    assert not check_focus(made(proxy, air)[0]).passed  # the cell's cover alone


def test_the_psf_of_a_lens_goes_through_its_films(proxy):
    one, _ = made(proxy)
    view = psf.View((2000.0,), ((0.0, 0.0),), 14.0, 28)
    corrected, bare = (
        psf.from_lens(lens_, view, tolerance=1e-3)
        for lens_ in (one, replace(one, layers=Layers()))
    )
    peaks = [float(s.intensity.max() * s.energy_um2[0, 0]) for s in (corrected, bare)]
    # 69 um of glass are 15 um of focus, 0.8 of the depth of focus
    assert peaks[0] > 1.5 * peaks[1]


def test_films_are_kept_in_the_file(proxy, tmp_path):
    one, _ = made(proxy)
    lens.save(tmp_path / "lens.h5", one)
    assert lens.load(tmp_path / "lens.h5").layers == one.layers == LAYERS
    lens.save(tmp_path / "bare.h5", replace(one, layers=Layers()))
    assert lens.load(tmp_path / "bare.h5").layers == Layers(cover=CELL.cover)


def test_films_that_cannot_be_are_refused_by_name(proxy):
    one, _ = made(proxy)
    with pytest.raises(
        PropagationError,
        match="layers: films of 201 um in the 200 um from lens to sensor",
    ):
        replace(one, layers=Layers(behind=(Film(Index(1.5), 201.0),)))
    with pytest.raises(PropagationError, match="source to lens"):
        Focus(0.85, 200.0, 2000.0, Layers(front=(Film(Index(1.5), 2001.0),)))
    with pytest.raises(LensError, match="cover"):
        replace(one, layers=Layers(cover="SiO2"))


@pytest.mark.parametrize("medium", [Layers(), LAYERS])
def test_maps_without_a_focus_are_known(medium):
    focus = replace(FOCUS, layers=medium)
    hyperbolic = design.phase_of(None, focus, radius_um=40.0)
    k = 2 * np.pi / 0.85
    random = np.random.default_rng(5).uniform(-np.pi, np.pi, (700, 700))

    def hologram(x, y):
        return random[
            np.ix_(np.rint(y * 8).astype(int) + 350, np.rint(x * 8).astype(int) + 350)
        ]

    def turned(charge, base):
        return lambda x, y: base(x, y) + charge * np.arctan2(y[:, None], x)

    def axicon(x, y):
        return -k * 0.12 * np.hypot(x, y[:, None])

    def flat(x, y):
        return np.zeros((len(y), len(x)))

    about = dict(radius_um=40.0, pitch_um=0.35)

    def bent(x, y):
        cubic = (x / 40) ** 3 + (y[:, None] / 40) ** 3
        return hyperbolic(x, y) + 5.0 * cubic + 0.02 * k * x

    assert design.has_focus(hyperbolic, focus, **about)
    assert design.has_focus(bent, focus, **about)
    for other in (
        axicon,
        flat,
        hologram,
        turned(1, flat),
        turned(3, hyperbolic),
        turned(1, hyperbolic),
    ):
        assert not design.has_focus(other, focus, **about)


def test_a_stop_is_kept_in_the_file_and_seen_by_design_and_focus_check(proxy, tmp_path):
    behind_stop = Layers(
        front=(Film(Index(1.45), 150.0),), stop=Stop(21.0, 150.0), cover=CELL.cover
    )
    focus = Focus(0.85, 200.0, 2000.0, behind_stop)
    one, quality = made(proxy, focus)
    lens.save(tmp_path / "stop.h5", one)
    assert lens.load(tmp_path / "stop.h5").layers == behind_stop
    # similar triangles in reduced distances
    lit = 21.0 / (1 - (150 / 1.45) / (1850 + 150 / 1.45))
    assert quality.numerical_aperture == pytest.approx(
        1.21 * np.sin(np.arctan(lit / 200.0)), rel=1e-6
    )
    found = check_focus(one)
    assert found.passed
    assert found.resolution_um == pytest.approx(
        0.85 / (2 * quality.numerical_aperture), rel=1e-6
    )
    # coma of the hyperbolic lens grows with the aperture cubed: less of it, a wider
    # field
    whole = made(proxy, Focus(0.85, 200.0, 2000.0, behind_stop.open))[1]
    assert quality.field_of_view_rad > 1.5 * whole.field_of_view_rad
