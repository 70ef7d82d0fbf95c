"""The modal engine's answers and error estimates against the committed reference values
of hard pillars.
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from metalens import modal, rcwa
from metalens.cell.record import Cell, Index
from metalens.core.errors import CellError

FILE = Path(__file__).parents[3] / "benchmarks" / "results" / "reference_pillars.json"
ENTRIES = json.loads(FILE.read_text(encoding="utf-8"))["entries"]
TALL = [e for e in ENTRIES if e["cell"]["height_um"] > 10]
NORMAL = [
    e
    for e in ENTRIES
    if e["angle_deg"] == 0.0 and e["uncertainty"] < 1e-5 and e not in TALL
]
OBLIQUE = [e for e in ENTRIES if e["angle_deg"] == 5.0]


def label(entry):
    return f"{entry['name']} {entry['diameter_um']:g} um {entry['angle_deg']:g} deg {entry['polarization']}"


def solve(entry, tolerance):
    parts = entry["cell"]
    media = [
        Index(*parts[name]) for name in ("pillar", "substrate", "cover", "between")
    ]
    return modal.solve(
        Cell(parts["pitch_um"], parts["height_um"], *media),
        entry["diameter_um"],
        entry["wavelength_um"],
        angle_rad=math.radians(entry["angle_deg"]),
        polarization=entry["polarization"],
        tolerance=tolerance,
    )


def test_the_table_is_as_good_as_it_says():
    """Subwavelength lossless cells conserve energy; most entries are known to 1e-6."""
    for entry in ENTRIES:
        power = (
            abs(np.array(entry["t"]) @ [1, 1j]) ** 2
            + abs(np.array(entry["r"]) @ [1, 1j]) ** 2
        )
        lossless = entry["cell"]["pillar"][1] == 0
        assert abs(power - 1) < 1e-11 if lossless else power < 1
    assert np.mean([entry["uncertainty"] < 1e-6 for entry in ENTRIES]) > 0.6


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
@pytest.mark.parametrize("entry", NORMAL, ids=label)
def test_error_estimate_holds(entry, tolerance):
    got = solve(entry, tolerance)
    error = abs(got.t - complex(*entry["t"]))
    assert got.converged
    assert error <= got.t_error + entry["uncertainty"]
    assert got.t_error <= tolerance


@pytest.mark.parametrize("entry", TALL, ids=label)
def test_hard_tall_pillars_know_their_error(entry):
    """Wavenumbers are wrong by the same share on a mesh, phases by that times the
    height: estimates grow with it.
    """
    got = solve(entry, 0.1)
    assert abs(got.t - complex(*entry["t"])) <= got.t_error + entry["uncertainty"]


@pytest.mark.parametrize("entry", OBLIQUE, ids=label)
def test_error_estimate_holds_oblique(entry):
    """With the dark mode near 272 nm, p, which only a broken symmetry sees."""
    got = solve(entry, 1e-2)
    assert abs(got.t - complex(*entry["t"])) <= got.t_error + entry["uncertainty"]


# pitch, height, indices of pillar, substrate, cover, between; diameter, wavelength
ALIKE = [
    ((0.4364, 1.8514), (2.9316, 1.302, 1.0744, 1.1737), (0.2165, 0.8488)),
    ((0.4472, 1.6471), (2.932, 1.4258, 1.0872, 1.2877), (0.2382, 0.9113)),
    ((0.4259, 2.3275), (3.2234, 1.4864, 1.265, 1.0788), (0.187, 0.8666)),
]


@pytest.mark.parametrize(("size", "media", "where"), ALIKE)
def test_one_guided_wave_that_both_forms_place_alike(size, media, where):
    """Tall discs of middle size: the wavenumbers of the forms cross there, so that
    their difference alone would be 2 to 8 times below the error.
    """
    where = Cell(*size, *map(Index, media)), *where
    want = modal.solve(*where, tolerance=1e-4)
    for tolerance in (3e-2, 1e-2, 1e-3):
        got = modal.solve(*where, tolerance=tolerance)
        assert abs(got.t - want.t) <= got.t_error + want.t_error


def test_error_estimate_holds_below_an_oblique_cutoff():
    """0.02 degrees before an order of the substrate appears, where 1/kz of that order
    is large.
    """
    where = Cell(pitch_um=0.45), 0.2, 0.85
    light = {
        "angle_rad": math.asin(0.85 / 0.45 - 1.4525) - math.radians(0.02),
        "polarization": "p",
    }
    got = modal.solve(*where, **light, tolerance=1e-2)
    want = modal.solve(*where, **light, tolerance=1e-3)
    assert abs(got.t - want.t) <= got.t_error + want.t_error


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("diameter", [1e-6, 1e-12])
def test_a_diameter_that_elements_cannot_follow_is_refused_by_name(diameter):
    """A picometre on a pitch of 0.4 um: no error of the linear algebra, no warning, a
    way out.
    """
    with pytest.raises(
        CellError, match=r"pitches: the elements .* degenerate .* use metalens\.rcwa"
    ):
        modal.solve(Cell(pitch_um=0.4), diameter, 0.85)


@pytest.mark.parametrize(
    "entry",
    [
        e
        for e in ENTRIES
        if e["name"] in ("128", "absorbing 0.1")
        or (e["diameter_um"], e["angle_deg"]) == (0.2, 10.0)
    ],
    ids=label,
)
def test_coupled_waves_agree(entry):
    """An independent method: Fourier harmonics instead of elements, one field form
    instead of two.
    """
    parts = entry["cell"]
    media = [
        Index(*parts[name]) for name in ("pillar", "substrate", "cover", "between")
    ]
    got = rcwa.solve(
        Cell(parts["pitch_um"], parts["height_um"], *media),
        entry["diameter_um"],
        entry["wavelength_um"],
        angle_rad=math.radians(entry["angle_deg"]),
        polarization=entry["polarization"],
        harmonics=9,
    )
    assert abs(got.t - complex(*entry["t"])) < max(got.t_error, 5e-3)
    assert abs(got.t - complex(*entry["t"])) < 2e-2


@pytest.mark.slow
@pytest.mark.parametrize(
    "entry", [e for e in NORMAL if e["uncertainty"] < 1e-6], ids=label
)
def test_fine_tolerance(entry):
    got = solve(entry, 2e-5)
    assert got.converged
    assert abs(got.t - complex(*entry["t"])) <= 2e-5


@pytest.mark.slow
def test_error_estimate_holds_on_held_out_pillars():
    """Random pillars that no factor was chosen on; truth from a mesh whose own estimate
    is far below.
    """
    rng = np.random.default_rng(2024)
    held, total = 0, 0
    for _ in range(60):
        pitch = rng.uniform(0.3, 0.42)
        pillar = Index(rng.uniform(1.8, 4.0), rng.choice([0.0, 0.01, 0.1]))
        layout = Cell(
            pitch, rng.uniform(0.2, 1.2), pillar, Index(1.4525), Index(1.0), Index(1.0)
        )
        where = layout, pitch * rng.uniform(0.05, 0.95), rng.uniform(0.8, 1.0)
        truth = modal.solve(*where, tolerance=5e-5)
        for tolerance in (1e-2, 1e-3):
            got = modal.solve(*where, tolerance=tolerance)
            held += abs(got.t - truth.t) <= got.t_error + truth.t_error
            total += 1
    assert held >= 0.999 * total
