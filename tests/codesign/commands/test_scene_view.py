"""Pages of rendered eyes and of a budget: what is shown is what the file holds."""

import math

import numpy as np

from codesign.budget.entry import BudgetEntry
from codesign.commands import budget, view
from metalens.core import store

FRAMES, SIZE = 3, 6


def test_eyes_are_shown_with_the_light_and_depth_of_the_sheet_in_front(tmp_path):
    random = np.random.default_rng(3)
    radiance = random.integers(0, 120, (FRAMES, 2, SIZE, SIZE)).astype(np.uint8)
    coverage = np.where(random.random((FRAMES, SIZE, SIZE)) < 0.4, 255, 10).astype(
        np.uint8
    )  # of the far sheet
    depth = random.integers(12_000, 30_000, (FRAMES, 2, SIZE, SIZE)).astype(np.uint16)
    slip = random.normal(size=(FRAMES, 3)) * 1e3
    arrays = {
        "radiance": radiance,
        "coverage": coverage,
        "depth_um": depth,
        "pupil": coverage,
        "labels/slip_um": slip,
    }
    store.save(tmp_path / "scene.h5", "scene", arrays, provenance=store.Provenance())
    eyes, far, pupil, table = view.scene_panels(tmp_path / "scene.h5")
    assert np.allclose(
        eyes.values, (radiance[:, 0].astype(float) + radiance[:, 1]) / 255, rtol=1e-12
    )
    assert np.allclose(
        far.values,
        np.where(coverage == 255, depth[:, 1], depth[:, 0]) / 1e3,
        rtol=1e-12,
    )
    assert np.allclose(pupil.values, coverage / 255, rtol=1e-12)
    assert table.head == ("frame", "slip / µm, x", "slip / µm, y", "slip / µm, z")
    assert table.rows[2] == [2, *slip[2].tolist()]


def test_a_budget_is_a_row_a_link_in_degrees(tmp_path):
    nan = math.nan
    rows = [
        BudgetEntry("fixation", nan, nan, 0.0123, "scatter"),
        BudgetEntry("field", 0.2, 1.5, nan, "off", counted=False),
    ]
    budget.save_budget(tmp_path / "budget.h5", rows, store.Provenance())
    (table,) = view.budget_panels(tmp_path / "budget.h5")
    assert table.rows[0] == (
        "fixation",
        "–",
        "–",
        math.degrees(0.0123),
        "yes",
        "scatter",
    )
    assert table.rows[1] == ("field", 0.2, 1.5, "–", "no", "off")
