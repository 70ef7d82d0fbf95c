"""Table 2 and Fig. 8b from finished runs: what each run counts as, ratios with a known
answer, gaze of two networks.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from codesign.evaluate import paper, paper_runs
from codesign.train import run as runs
from metalens.core.errors import TrainingError
from tests.codesign import made_lens as m

KEYS = ("population_floor_deg", "personal_deg", "personal_floor_deg", "anatomy_deg")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("paper_runs") / "run"
    m.finished_run(path)
    return path


def _result(path, **entries):
    path.mkdir(parents=True)
    rows = [
        {"budget_mmacs": b, "mmacs": b, "axial_slip_mm": e}
        for b, e in entries.pop("rows", ((2.0, 1.0),))
    ]
    (path / "result.json").write_text(json.dumps({"rows": rows, **entries}))
    return path


def test_compute_of_a_frozen_part_is_that_at_its_own_best_error():
    ours = [{"mmacs": 2.0, "axial_slip_mm": 0.9}, {"mmacs": 6.0, "axial_slip_mm": 0.5}]
    fixed = [
        {"mmacs": 4.0, "axial_slip_mm": 1.2},
        {"mmacs": 14.0, "axial_slip_mm": 0.9},
    ]
    better = [{"mmacs": 9.0, "axial_slip_mm": 0.4}]
    found = paper_runs.of_ablations(ours, {"optics": fixed, "pitch": better})
    assert (
        found["fig8b/optics"].value == 7.0
    )  # 14 MMACs for 0.9 mm, which 2 MMACs of ours reach
    assert "0.90 mm" in found["fig8b/optics"].conditions
    assert "fig8b/pitch" not in found  # ours never gets there: no number is made up
    assert {claim.key for claim in paper.load_claims()} >= {
        "fig8b/optics",
        "fig8b/pitch",
    }


def test_lenses_are_compared_at_the_largest_tolerance_of_their_runs(monkeypatch):
    told = {
        Path("a/run.toml"): 0.04,
        Path("b/run.toml"): 0.11,
        Path("c/run.toml"): 0.07,
    }
    monkeypatch.setattr(
        runs,
        "load_run_settings",
        lambda path: SimpleNamespace(
            optics=SimpleNamespace(image_tolerance=told[path])
        ),
    )
    assert paper_runs.image_tolerance([Path("a"), Path("b"), Path("c")]) == 0.11


def test_runs_are_told_apart_by_what_they_wrote(tmp_path):
    one = _result(tmp_path / "a", frozen=["optics"])
    two = _result(tmp_path / "b", frozen=["pitch", "optics"])
    three = _result(tmp_path / "c", frozen=[])
    assert [part for part, _ in paper_runs.frozen_rows((one, two, three))] == ["optics"]
    again = _result(tmp_path / "d", frozen=["optics"])
    with pytest.raises(
        TrainingError, match="both have optics frozen; give one of them"
    ):
        list(paper_runs.frozen_rows((one, again)))
    with pytest.raises(TrainingError, match="no finished run"):
        paper_runs.kind_of(tmp_path)
