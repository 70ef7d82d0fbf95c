"""The paper beside ours: transcription against the paper's own text, ratios, and what
is said of what is missing.
"""

import json
import re

import pytest

from codesign.commands import paper as command_paper
from codesign.evaluate import paper
from codesign.evaluate.paper import MeasuredNumber
from tests.codesign import made_lens as m
from tests.command_line import call, printed

RATIO = re.compile(r"^([\d.]+) / ([\d.]+)")


def test_every_number_stands_in_the_paper(shared):
    text = "\n".join(
        path.read_text(encoding="utf-8") for path in (shared / "paper").glob("*.txt")
    )
    numbers = set(re.findall(r"\d+\.\d+|\d+", text.replace(",", "")))
    known = {float(n) for n in numbers}
    for claim in paper.load_claims():
        for number in re.findall(r"\d+\.\d+", claim.note):
            assert float(number) in known, claim
        if not claim.picture and claim.unit != "ratio":
            assert claim.value in known, claim
    for words in ("40%", "~50%", "7× fewer", "3× fewer"):
        assert words in text.replace(r"\%", "%")


def test_measurements_of_optics_are_ratios_to_the_hyperbolic_lens_at_equal_angles(
    tmp_path,
):
    """Information summed over the channels of its first row; scenes with their own
    intervals.
    """

    def lens(scene, *angles):
        return {
            "scene_ratios": {"axial": scene},
            "information_per_mm2": [[one, [9.0, 7.0]] for one in angles],
        }

    told = {
        "angles_deg": [0, 12.5], "normalisation": "light",
        "lenses": {
            "proposed": lens([1.7, 1.4, 2.3], [3.0, 5.0], [2.0, 1.5]),
            "hyperbolic": lens([1.0, 0.9, 1.2], [1.5, 0.5], [4.0, 1.0]),
        },
    }  # fmt: skip
    path = tmp_path / "optics.json"
    path.write_text(json.dumps(told))
    found = paper.of_optics(path)
    assert found["scenes/axial/proposed"] == MeasuredNumber(
        1.7, 1.4, 2.3, "same states, images of equal light"
    )
    assert found["information/0/proposed"].value == pytest.approx(8.0 / 2.0)
    assert found["information/12.5/proposed"].value == pytest.approx(3.5 / 5.0)
    assert found["information/12.5/hyperbolic"].value == 1
    del told["lenses"]["hyperbolic"]
    path.write_text(json.dumps(told))
    assert set(paper.of_optics(path)) == {"scenes/axial/proposed"}


def _experiment(path, axial):
    row = {
        "mmacs": 2.0,
        "gaze_axial_deg": axial,
        "gaze_lateral_deg": 1.0,
        "slip_mm": 0.4,
        "iou": 0.9,
    }
    rows = [
        {**row, "name": "proposed", "iou_interval": [0.8, 1.0]},
        {**row, "name": "hyperbolic", "gaze_axial_deg": 2.0},
    ]
    ratio = {
        "quantity": "gaze_axial_deg",
        "against": "hyperbolic",
        "ratio": axial / 2,
        "interval": [0.1, 0.9],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    about = {"subjects": 3, "frames": 9, "seed": 0}
    path.write_text(
        json.dumps(
            {"first": "proposed", "settings": about, "runs": rows, "ratios": [ratio]}
        )
    )


def test_measurements_are_collected_from_their_files(tmp_path):
    _experiment(tmp_path / "experiment" / "experiment.json", 1.0)
    _experiment(tmp_path / "dim" / "experiment.json", 1.5)
    found = command_paper.collect_measurements(tmp_path, {})
    assert found["gaze_axial/ratio"].value == 0.5
    assert found["iou/proposed"].low == 0.8
    assert found["dim/proposed"].value == pytest.approx(1.5)
    assert found["dim/hyperbolic"].value == pytest.approx(2.0 / 1.5)


def test_equal_budgets_and_equal_accuracy_of_two_runs():
    def rows(*pairs):
        return [{"budget_mmacs": b, "mmacs": b, "axial_slip_mm": e} for b, e in pairs]

    found = paper.of_runs(
        {
            "proposed": rows((2.0, 0.5), (8.0, 0.3)),
            "hyperbolic": rows((2.0, 1.0), (8.0, 0.5)),
        }
    )
    assert found["fig8a/error"].value == 0.5
    assert found["fig8a/compute"].value == 0.25
    assert paper.of_runs({"proposed": rows((2.0, 0.5))}) == {}


def test_the_command_lists_claims_and_overwrites_only_by_force(tmp_path, capsys):
    words = f"evaluate paper -o {tmp_path}/out"
    assert call(f"{words} --json") == 0
    told = printed(capsys)
    assert len(told["lines"]) == len(paper.load_claims())
    assert all(line["ours"] is None for line in told["lines"])
    assert "not measured" in (tmp_path / "out" / "report.html").read_text()
    assert call(words) == 2
    assert "give --force" in capsys.readouterr().err
    assert call(f"{words} {tmp_path} --force --no-measure") == 2
    assert "no finished run" in capsys.readouterr().err


@pytest.mark.slow
def test_one_command_measures_and_compares(tmp_path, capsys):
    # a toy's PSFs change from pixel to pixel
    text = m.TINY.replace("[optics]", "[optics]\nimage_tolerance = 0.5")
    for name in ("a", "b"):
        m.finished_run(tmp_path / name, text)
    words = f"evaluate paper {tmp_path}/a {tmp_path}/b -o {tmp_path}/out --json"
    assert call(f"{words} --subjects 2 --scenes 2") == 0
    told = {line["key"]: line for line in printed(capsys)["lines"]}
    assert told["gaze_axial/ratio"]["ours"]["value"] == 1.0  # the same run twice
    assert told["scenes/slip/proposed"]["ours"]["value"] == pytest.approx(1.0)
    assert told["picture/experiment/ambiguity.png"]["picture"]
