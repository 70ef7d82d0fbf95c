"""What finished runs say to the paper: which row is taken, and what is divided by what."""

import json
from types import SimpleNamespace

import pytest

from codesign.evaluate import paper_runs
from codesign.evaluate.paper_runs import of_ablations, of_gaze


def row(mmacs, personal):
    return {"mmacs": mmacs, "personal_deg": personal, "people": 12, "seed": 5}


def test_the_first_elastic_network_is_ours_its_least_row_the_efficient_one():
    """Least compute stands first; the accurate one is the least error of the personal
    calibration.
    """
    told = {
        "a": {
            "network": "supernet",
            "rows": [row(1.26, 2.4), row(3.0, 0.9), row(7.0, 1.1)],
        },
        "b": {"network": "supernet", "rows": [row(0.5, 0.2)]},
        "c": {"network": "nvgaze", "rows": [row(40.0, 3.3), row(50.0, 1.0)]},
        "d": {"network": "unet", "rows": [row(40.0, 0.1)]},
    }
    found = of_gaze(told)
    values = {key: one.value for key, one in found.items()}
    assert values == {
        "table2/proposed_efficient": 2.4,
        "table2/proposed_accurate": 0.9,
        "table2/nvgaze": 3.3,
    }
    words = found["table2/proposed_efficient"].conditions
    assert words.startswith(
        "1.3 MMACs, 12 synthetic people, seed 5, visual axis after a personal calibration"
    )


def test_a_frozen_part_costs_its_compute_over_the_least_of_ours_that_is_as_good():
    """Its best is 0.6 mm at 9 MMACs; ours reaches that, and just that, at 4.5 and with
    more at 6.
    """
    ours = [
        {"mmacs": m, "axial_slip_mm": e}
        for m, e in ((6.0, 0.5), (4.5, 0.6), (2.0, 0.61))
    ]
    frozen = [
        {"mmacs": m, "axial_slip_mm": e}
        for m, e in ((3.0, 0.9), (9.0, 0.6), (12.0, 0.8))
    ]
    found = of_ablations(
        ours, {"optics": frozen, "pitch": [{"mmacs": 1.0, "axial_slip_mm": 0.4999}]}
    )
    assert set(found) == {"fig8b/optics"}
    assert found["fig8b/optics"].value == pytest.approx(2.0, rel=1e-12)
    assert (
        found["fig8b/optics"].conditions
        == "axial slippage of 0.60 mm or less, at 4.5 MMACs"
    )


def test_one_frozen_part_of_an_elastic_network_is_an_ablation(tmp_path):
    def written(name, **told):
        (tmp_path / name).mkdir()
        rows = [{"budget_mmacs": 3.0, "mmacs": 2.0, "axial_slip_mm": 1.0}]
        (tmp_path / name / "result.json").write_text(json.dumps({"rows": rows, **told}))
        return tmp_path / name

    plain = written("plain")  # older files name neither
    assert paper_runs.kind_of(plain) == paper_runs.Kind("supernet", ())
    two, one = (
        written(str(len(parts)), network="supernet", frozen=parts)
        for parts in (["optics", "pitch"], ["pitch"])
    )
    folders = [plain, two, one, written("other", network="nvgaze", frozen=["optics"])]
    ((part, rows),) = paper_runs.frozen_rows(folders)
    assert (part, rows[0]["mmacs"]) == ("pitch", 2.0)


def test_people_are_sixteen_with_forty_frames_and_twice_as_many_tell_of_the_axis():
    assert (paper_runs.PEOPLE, paper_runs.EACH, paper_runs.BEFORE) == (16, 40, 32)


def test_lenses_are_compared_at_the_largest_tolerance(monkeypatch):
    told = iter([0.04, 0.11, 0.07])
    about = SimpleNamespace
    monkeypatch.setattr(
        paper_runs.runs,
        "load",
        lambda path: about(optics=about(image_tolerance=next(told))),
    )
    assert paper_runs.image_tolerance([paper_runs.Path(name) for name in "abc"]) == 0.11


def test_networks_of_a_run_are_judged_on_people_of_one_seed_and_learn_of_others_of_the_next(
    tmp_path, monkeypatch
):
    """Rows by their compute; 32 x 7 frames in 15 batches of 15; people before only
    where an axis is read.
    """
    asked = []
    trainer = SimpleNamespace(scenes="training", model=SimpleNamespace(net="net"))
    going = SimpleNamespace(
        trainer=trainer, scenes=lambda stream: f"stream {stream}",
        settings=SimpleNamespace(inner=SimpleNamespace(batch=15)),
    )  # fmt: skip
    monkeypatch.setattr(
        paper_runs.runs, "load", lambda path: SimpleNamespace(test_batches=11)
    )
    monkeypatch.setattr(paper_runs.runs, "resume", lambda path, settings: going)
    rows = [{"mmacs": m, "architecture": m} for m in (7.0, 2.0)]
    monkeypatch.setattr(paper_runs.retraining, "rows_of", lambda folder: rows)
    monkeypatch.setattr(
        paper_runs.retraining, "architecture_of", lambda entry, run, folder: entry
    )
    monkeypatch.setattr(
        paper_runs,
        "recalibrate",
        lambda net, member, known: asked.append(("norm", member, known)),
    )
    monkeypatch.setattr(
        paper_runs.gaze_test, "people", lambda *about, seed: (*about, seed)
    )
    monkeypatch.setattr(
        paper_runs.assess, "frames", lambda trainer, scenes, count: (scenes, count)
    )
    monkeypatch.setattr(paper_runs.assess, "parts", lambda seen: seen)
    monkeypatch.setattr(
        paper_runs,
        "_read",
        lambda going, member, shown: SimpleNamespace(
            axis_deg=None if member == 2.0 else shown
        ),
    )
    monkeypatch.setattr(
        paper_runs.gaze_test, "learnt", lambda before, read: (before, read.axis_deg[1])
    )
    monkeypatch.setattr(
        paper_runs.gaze_test,
        "gaze_errors",
        lambda test, read, how: asked.append((test, how)),
    )
    monkeypatch.setattr(paper_runs, "asdict", lambda found: {"found": found})
    out = paper_runs.gaze(tmp_path, people=5, each=7, seed=3)
    shown, others = ("stream 2", 5, 7, 3), ("stream 1", 32, 7, 4)
    assert asked == [
        ("norm", 2.0, ("training", 8)), (shown, None), ("norm", 7.0, ("training", 8)),
        (shown, (others, (others, 15))),
    ]  # fmt: skip
    assert [one["mmacs"] for one in out] == [2.0, 7.0]
    assert (out[0]["people"], out[0]["frames_each"], out[0]["seed"]) == (5, 7, 3)
