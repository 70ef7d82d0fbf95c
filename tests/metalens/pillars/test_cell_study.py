"""The cell study: known coverages, the choice, and the page."""

import dataclasses
import json

import numpy as np
import pytest

from metalens.ground.errors import CellError, ConfigError
from metalens.pillars import study as cell_study
from metalens.pillars import study_plots
from metalens.pillars.study import Study

SMALL = Study(pitches_um=(0.30, 0.40), heights_um=(0.7,), wavelengths_um=(0.85,), tolerance=1e-2)


@pytest.fixture(scope="module")
def verdicts():
    return cell_study.run(SMALL)


def test_known_coverages(verdicts):
    narrow, wide, film = verdicts
    assert narrow.turns == pytest.approx(1.53, abs=0.03)
    assert wide.turns == pytest.approx(0.77, abs=0.03)
    assert narrow.max_angle_deg == 90
    assert wide.max_angle_deg == pytest.approx(42.3, abs=0.1)  # sin = 0.85/0.40 - 1.4525
    assert film.pillar == "a-Si"
    assert film.turns < 0.6  # the absorbing film of Pierce and Spicer


def test_choice_takes_the_lowest_then_the_most(verdicts):
    narrow, wide, _ = verdicts
    assert cell_study.choice(SMALL, verdicts) == (0.30, 0.7)
    taller = dataclasses.replace(narrow, height_um=0.9, turns=2.0)
    assert cell_study.choice(SMALL, [taller, narrow]) == (0.30, 0.7)
    better = dataclasses.replace(narrow, pitch_um=0.31, turns=1.6)
    assert cell_study.choice(SMALL, [narrow, better]) == (0.31, 0.7)
    elsewhere = dataclasses.replace(better, wavelength_um=0.94, turns=0.4)
    assert cell_study.choice(SMALL, [narrow, better, elsewhere]) == (0.30, 0.7)
    assert cell_study.choice(SMALL, [wide]) is None


def test_page_json_and_figure(verdicts, tmp_path):
    study_plots.write_study(tmp_path, SMALL, verdicts, command="metalens study")
    page = (tmp_path / "README.md").read_text()
    assert f"| 700 | **{verdicts[0].turns:.2f}**" in page
    assert "pitch of 300 nm" in page
    assert "Made by `metalens study`" in page
    values = json.loads((tmp_path / "cell_study.json").read_text())
    assert values["verdicts"][1]["pitch_um"] == 0.4
    assert (tmp_path / "cell_study.png").read_bytes().startswith(b"\x89PNG")
    first = (tmp_path / "cell_study.png").read_bytes()
    study_plots.write_study(tmp_path, SMALL, verdicts, command="metalens study")
    assert (tmp_path / "cell_study.png").read_bytes() == first


def test_no_cell_is_said_plainly(verdicts):
    only = dataclasses.replace(SMALL, pitches_um=(0.40,))
    assert "No cell covers a full turn at 850 nm" in cell_study.markdown(only, verdicts[1:2], command="x")


def test_most_phase_of_runs():
    phase = np.arange(10.0)
    good = np.array([1, 1, 0, 1, 1, 1, 1, 0, 1, 1], bool)
    assert cell_study._most_phase(phase, good) == (3, 7)
    assert cell_study._most_phase(phase, ~good & False) == (0, 0)


def test_pitch_without_room_is_refused():
    with pytest.raises(ConfigError, match="no pillar of"):
        Study(pitches_um=(0.12,))


def test_pitches_above_cutoff_are_refused_and_named():
    with pytest.raises(CellError, match=r"pitch 0.7 um at 0.85 um: diffraction orders"):
        cell_study.run(Study(pitches_um=(0.3, 0.7), heights_um=(0.5,), wavelengths_um=(0.85,)))
