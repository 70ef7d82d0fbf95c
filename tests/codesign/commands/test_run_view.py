"""A run's folder to be looked at: while it trains, and when it has ended."""

import json

import numpy as np
import pytest

from codesign.commands import view
from metalens import cli
from metalens.core import store
from metalens.core.errors import StoreError


def line(step, loss):
    return json.dumps(
        {
            "kind": "step",
            "step": step,
            "loss": loss,
            "depth_error_mm": 2 * loss,
            "seed": 4,
        }
    )


def test_a_run_that_goes_on_shows_what_its_log_holds_so_far(tmp_path):
    birth = json.dumps({"kind": "birth", "step": 3})
    (tmp_path / "log.jsonl").write_text(
        "\n".join([line(1, 0.7), line(3, 0.5), birth, line(4, 0.3), '{"kind": "st'])
    )
    panels = view.run_panels(tmp_path)
    # the seed stands still
    assert [panel.title for panel in panels] == [
        "Training: loss",
        "Training: depth error / mm",
    ]
    assert panels[1].x.tolist() == [1, 3, 4]
    assert np.allclose(panels[1].lines["depth error / mm"], [1.4, 1.0, 0.6], rtol=1e-15)
    assert (
        cli.main(["view", str(tmp_path), "-o", str(tmp_path / "page.html"), "--quiet"])
        == 0
    )


def test_networks_are_a_row_each(tmp_path):
    rows = [
        {"budget_mmacs": 3.5, "axial_mm": 0.61},
        {"budget_mmacs": None, "axial_mm": 0.48},
    ]
    (tmp_path / "result.json").write_text(json.dumps({"rows": rows}))
    (table,) = view.run_panels(tmp_path)
    assert table.head == ["axial / mm", "budget / million MACs"]
    assert table.rows == [[0.61, 3.5], [0.48, None]]
    (tmp_path / "result.json").write_text("[1]")
    with pytest.raises(
        StoreError, match=r"result.json: need a table of names and values, found list"
    ):
        view.run_panels(tmp_path)


def birth(mmacs, error, kernel, budget=3.0):
    held = {
        "depths": [1, 2],
        "kernels": [3, kernel, 5, 7],
        "expansions": [3, 4, 6, 3],
        "width": 0.5,
        "resolution": 0.8,
    }
    return json.dumps(
        {
            "kind": "birth",
            "budget_mmacs": budget,
            "error": error,
            "mmacs": mmacs,
            "architecture": held,
        }
    )


def test_networks_of_the_searches_are_points_to_pick_with_the_pareto_set_among_them(
    tmp_path,
):
    # 2.5 costs more than 1.5 and errs more: beaten. 2.0 errs as much as 1.5 and costs
    # more: beaten
    born = [
        (2.5, 0.9, 3),
        (1.5, 0.8, 5),
        (2.8, 0.6, 3),
        (1.2, 1.1, 7),
        (2.0, 0.8, 3),
        (1.1, float("nan"), 3),
    ]
    (tmp_path / "log.jsonl").write_text("\n".join(birth(*one) for one in born))
    (points,) = view.run_panels(tmp_path)
    assert points.x == [2.5, 1.5, 2.8, 1.2, 2.0]
    assert points.front == [3, 1, 2]
    assert points.notes[1]["stage 1"] == "3×3 × 3"  # one block of two slots is used
    assert points.notes[1]["stage 2"] == "5×5 × 6, 7×7 × 3"
    old = json.dumps({"kind": "birth", "budget_mmacs": 3.0, "error": 0.7, "mmacs": 2.0})
    (tmp_path / "log.jsonl").write_text(old)  # of a run that did not say what was born
    assert view.run_panels(tmp_path)[0].notes == [{}]


def test_answers_stand_beside_the_truth(tmp_path):
    rng = np.random.default_rng(5)
    arrays = {
        "frames": rng.normal(size=(2, 6, 6)).astype(np.float32),
        "slip_um": np.array([[100.0, -200.0, 300.0], [400.0, 500.0, -600.0]]),
        "told_slip_um": np.array([[[110.0, -190.0, 310.0], [390.0, 510.0, -590.0]]]),
        "interval_um": np.array([[250.0, 130.0]]),
        "pupil": rng.random((2, 6, 6)),
        "told_pupil": rng.random((1, 2, 6, 6)),
    }
    store.save(
        tmp_path / "a.h5",
        "answers",
        arrays,
        attributes={"network_0": "budget 3 million MACs"},
    )
    frames, pupil, table = view.prediction_panels(tmp_path / "a.h5")
    assert frames.values.shape == (2, 6, 6)
    assert np.array_equal(
        pupil.values[0, 1, 0], arrays["pupil"][1]
    )  # network, frame, then truth and answer
    assert np.array_equal(pupil.values[0, 1, 1], arrays["told_pupil"][0, 1])
    assert table.head[2:4] == ("true x / mm", "read x / mm")
    assert np.allclose(
        table.rows[0][2:], [0.1, 0.11, -0.2, -0.19, 0.3, 0.31, 0.25], rtol=1e-12
    )
    assert table.rows[1][-1] == pytest.approx(0.13)
