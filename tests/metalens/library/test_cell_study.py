"""The cell study: known coverages, the choice, and the files."""

import dataclasses
import json

import pytest

from metalens.cell import Cell, Index, Layer
from metalens.core.errors import CellError, ConfigError
from metalens.library import plots
from metalens.library import study as cell_study
from metalens.library.study import CellStudy

SMALL = CellStudy(
    pitches_um=(0.30, 0.40), heights_um=(0.7,), wavelengths_um=(0.85,), tolerance=1e-2
)


@pytest.fixture(scope="module")
def verdicts():
    return cell_study.run_study(SMALL)


def test_known_coverages(verdicts):
    narrow, wide = verdicts
    assert narrow.turns == pytest.approx(1.53, abs=0.03)
    assert wide.turns == pytest.approx(0.77, abs=0.03)
    assert narrow.max_angle_deg == 90
    # sin = 0.85/0.40 - 1.4525
    assert wide.max_angle_deg == pytest.approx(42.3, abs=0.1)


def test_choice_takes_the_lowest_then_the_most(verdicts):
    narrow, wide = verdicts
    assert cell_study.best_cell(verdicts) == (0.30, 0.7)
    taller = dataclasses.replace(narrow, height_um=0.9, turns=2.0)
    assert cell_study.best_cell([taller, narrow]) == (0.30, 0.7)
    better = dataclasses.replace(narrow, pitch_um=0.31, turns=1.6)
    assert cell_study.best_cell([narrow, better]) == (0.31, 0.7)
    elsewhere = dataclasses.replace(better, wavelength_um=0.94, turns=0.4)
    assert cell_study.best_cell([narrow, better, elsewhere]) == (0.30, 0.7)
    assert cell_study.best_cell([wide]) is None


def test_json_and_figure(verdicts, tmp_path):
    plots.write_study(tmp_path, SMALL, verdicts)
    values = json.loads((tmp_path / "cell_study.json").read_text())
    assert values["verdicts"][1]["pitch_um"] == 0.4
    assert (tmp_path / "cell_study.png").read_bytes().startswith(b"\x89PNG")
    first = (tmp_path / "cell_study.png").read_bytes()
    plots.write_study(tmp_path, SMALL, verdicts)
    assert (tmp_path / "cell_study.png").read_bytes() == first


def test_pitch_without_room_is_refused():
    with pytest.raises(ConfigError, match="no pillar of"):
        CellStudy(pitches_um=(0.12,))


def test_pitches_above_cutoff_are_refused_and_named():
    with pytest.raises(CellError, match=r"pitch 0.9 um at 0.85 um: diffraction orders"):
        cell_study.run_study(
            CellStudy(pitches_um=(0.3, 0.9), heights_um=(0.5,), wavelengths_um=(0.85,))
        )


def test_heights_of_layered_pillars_are_made_of_their_own_material():
    """Pedestal and residual mask stay 60 and 40 nm; what they fill leaves no pillar."""
    layers = (
        Layer(0.06, material=Index(1.5)),
        Layer(0.5),
        Layer(0.04, grow_um=-0.01, material=Index(1.9)),
    )
    study = dataclasses.replace(SMALL, cell=Cell(0.3, 0.6, Index(3.6), layers=layers))
    made = study.at(0.33, 0.75)
    assert [layer.height_um for layer in made.layers] == pytest.approx(
        [0.06, 0.65, 0.04]
    )
    assert (made.pitch_um, made.height_um, made.pillar) == (0.33, 0.75, Index(3.6))
    with pytest.raises(
        CellError, match=r"0\.1 um of it of other films: need a larger height"
    ):
        study.at(0.33, 0.09)
