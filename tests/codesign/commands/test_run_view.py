"""A run's folder to be looked at: while it trains, and when it has ended."""

import json

import numpy as np
import pytest

from codesign.commands import view
from metalens.core.errors import StoreError
from tests.command_line import call


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
    assert call(f"view {tmp_path} -o {tmp_path}/page.html --quiet") == 0


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
