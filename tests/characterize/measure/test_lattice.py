"""Lattices of any kind and pillars with bright rims or dark tops, found and laid on a
design that is known.
"""

import numpy as np
import pytest

from characterize.measure import overlay, sem
from metalens.cell import Lattice
from metalens.core.errors import CaptureError
from metalens.lens import DiameterMap
from tests.characterize.micrographs import draw_pillars

PIXEL, PITCH = 3.7, 310.0  # nm


def picture(place_px, diameter_nm, shape, *, top=0.35):
    """Discs with a bright rim of 5 px and a top of its own."""
    rng = np.random.default_rng(0)
    look = {"top": top, "rim": 1.0, "rim_px": 5.0, "blur": 1.2, "noise": 0.04}
    sizes = np.asarray(diameter_nm) / PIXEL
    return 3000 * draw_pillars(shape, place_px, sizes, rng=rng, **look) + 500


def lattice(turn_deg, angle_deg, ratio, shape, jitter=0.0, seed=0):
    """Places of all sites in the picture for a lattice turned by ``turn_deg``, its
    vectors ``angle_deg`` apart.
    """
    turns = np.radians([turn_deg, turn_deg + angle_deg])
    vectors = PITCH / PIXEL * np.stack([np.sin(turns), np.cos(turns)], 1)
    a, b = vectors * [[1.0], [ratio]]
    index = np.mgrid[-12:13, -12:13].reshape(2, -1).T
    place = np.array([11.3, 17.9]) + index[:, :1] * a + index[:, 1:] * b
    keep = ((place > -60) & (place < np.array(shape) + 60)).all(1)
    return place[keep]


@pytest.mark.parametrize(
    ("turn", "angle", "ratio", "kind", "top"),
    [
        (7.0, 90.0, 1.0, "square", 0.35),
        (3.0, 60.0, 1.0, "hexagonal", 0.9),
        (0.0, 90.0, 1.3, "rectangular", 0.35),
    ],
)
def test_pillars_of_any_lattice_are_all_measured(turn, angle, ratio, kind, top):
    shape = (330, 370)
    place = lattice(turn, angle, ratio, shape)
    truth = np.random.default_rng(5).uniform(140, 230, len(place))
    found = sem.measure_diameters(
        picture(place, truth, shape, top=top), sem.SemMicrograph(PIXEL)
    )
    assert found.lattice.kind == kind
    assert not (found.missing | found.collapsed).any()
    seen = np.stack([found.row, found.column], 1)
    apart = np.linalg.norm(seen[:, None] - place[None], axis=2)
    assert apart.min(1).max() < 0.3  # pixels
    error_px = (found.diameter_nm - truth[apart.argmin(1)]) / PIXEL
    # blur of 1.2 px moves the half level of a rim 5 px wide by less
    assert abs(error_px.mean()) < 0.6
    assert error_px.std() < 0.25


def test_a_picture_of_one_line_of_waves_is_refused():
    waves = np.sin(np.arange(200) / 5)[None] + 0 * np.arange(160)[:, None]
    with pytest.raises(CaptureError, match="no lattice"):
        sem.measure_diameters(waves, sem.SemMicrograph(PIXEL))


def drawn(rows=40, columns=44):
    """Diameters that vary as those of a lens, asymmetric."""
    y, x = np.mgrid[:rows, :columns]
    return 185 + 40 * np.sin(0.013 * ((x - 9.3) ** 2 + 1.3 * (y - 31.7) ** 2)) + 1.1 * x


@pytest.mark.parametrize(
    ("design", "angle_deg", "ratio", "turn_deg"),
    [
        (Lattice("hexagonal"), 60.0, 1.0, 4.0),
        (Lattice("hexagonal"), 120.0, 1.0, -9.0),
        (Lattice("rectangular", 1.3), 90.0, 1.3, 3.0),
    ],
)
def test_a_picture_of_any_lattice_finds_its_place_on_the_mask(
    design, angle_deg, ratio, turn_deg
):
    """Pillars are drawn by their place on the mask, in um from its first; the picture
    is that place turned.
    """
    mask = drawn(44, 60)
    if design.centred:
        mask *= np.indices(mask.shape).sum(0) % 2 == 0
    made = DiameterMap(mask * 1e-3, PITCH * 1e-3, design)
    shape = (420, 470)
    place = lattice(turn_deg, angle_deg, ratio, shape)
    turn = np.radians(turn_deg)
    # (row, column) of the mask
    back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    steps_px = np.array(made.steps_um[::-1]) * 1e3 / PIXEL
    index = np.rint((place - [11.3, 17.9]) @ back.T / steps_px).astype(int) + np.array(
        [20, 22]
    )
    wide = mask[tuple(index.T)] - 3.1
    found = sem.measure_diameters(
        picture(place, wide, shape), sem.SemMicrograph(PIXEL, PITCH)
    )
    laid = overlay.overlay_design(found, made)
    assert laid.clearly
    apart = np.hypot(
        found.row[:, None] - place[:, 0], found.column[:, None] - place[:, 1]
    )
    assert np.array_equal(laid.site, index[apart.argmin(1)])
    # edges of a blurred rim: as below
    assert np.nanmean(laid.error_nm) == pytest.approx(-3.1, abs=0.6 * PIXEL)
    assert overlay.lattice_scale(found, PIXEL, made) == pytest.approx(1.0, abs=1e-3)
    assert np.count_nonzero(laid.outlier) < 2


def test_a_picture_across_the_mask_is_refused():
    """Rows of a hexagonal lattice along y, where those of a mask run along x."""
    shape = (330, 370)
    place = lattice(30.0, 60.0, 1.0, shape)
    found = sem.measure_diameters(
        picture(place, np.full(len(place), 180.0), shape),
        sem.SemMicrograph(PIXEL, PITCH),
    )
    made = DiameterMap(
        np.where(np.indices((44, 60)).sum(0) % 2, 0, 0.18),
        PITCH * 1e-3,
        Lattice("hexagonal"),
    )
    with pytest.raises(
        CaptureError,
        match="rows of this hexagonal lattice do not lie in the picture as on the mask",
    ):
        overlay.overlay_design(found, made)
    with pytest.raises(
        CaptureError,
        match="the picture shows a hexagonal lattice, the design is square",
    ):
        overlay.overlay_design(
            found, DiameterMap(np.full((44, 60), 0.18), PITCH * 1e-3)
        )
