"""RCWA against the committed reference values of hard pillars, which the modal method
made.
"""

import json
import math
from pathlib import Path

import pytest

from metalens import rcwa
from metalens.cell.record import Cell, Index

FILE = Path(__file__).parents[3] / "benchmarks" / "results" / "reference_pillars.json"
ENTRIES = json.loads(FILE.read_text(encoding="utf-8"))["entries"]


def label(entry):
    return f"{entry['name']} {entry['diameter_um']:g} um {entry['angle_deg']:g} deg {entry['polarization']}"


def solve(entry, harmonics):
    parts = entry["cell"]
    media = [
        Index(*parts[name]) for name in ("pillar", "substrate", "cover", "between")
    ]
    return rcwa.solve(
        Cell(parts["pitch_um"], parts["height_um"], *media),
        entry["diameter_um"],
        entry["wavelength_um"],
        angle_rad=math.radians(entry["angle_deg"]),
        polarization=entry["polarization"],
        harmonics=harmonics,
    )


@pytest.mark.parametrize("entry", ENTRIES, ids=label)
def test_error_estimate_holds(entry):
    got = solve(entry, 8)
    error = abs(got.t - complex(*entry["t"]))
    assert error <= got.t_error + entry["uncertainty"]
    # the estimate is made for t
    assert abs(got.r - complex(*entry["r"])) <= 3 * got.t_error + entry["uncertainty"]
    if entry["cell"]["pillar"][1] == 0:
        assert abs(got.energy - 1) < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize(
    "entry", [e for e in ENTRIES if e["angle_deg"] == 0.0], ids=label
)
def test_error_estimate_holds_at_high_order(entry):
    got = solve(entry, 14)
    assert abs(got.t - complex(*entry["t"])) <= got.t_error + entry["uncertainty"]
