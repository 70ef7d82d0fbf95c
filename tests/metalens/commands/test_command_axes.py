"""``metalens library`` over two sizes: what is said, written and shown; failures of the result end with 1."""

import json

import numpy as np
import pytest

from metalens import rcwa
from metalens.cli import main
from metalens.pillars import axes
from metalens.view import artefacts

CELL = """
[cell]
pitch_um = 0.3
height_um = 0.35
pillar = {{ n = 1.6 }}
substrate = {{ n = 1.4 }}
[cell.shape]
kind = "rectangle"{ratio}
[sweep]
wavelengths_um = [0.71]
diameters_um = [0.09, 0.2]
lengths_um = [0.08, {longest}]
samples = 24
tolerance = {tolerance}
"""


def made(folder, capsys, *, ratio="", longest=0.23, tolerance=0.1):
    (folder / "cell.toml").write_text(CELL.format(ratio=ratio, longest=longest, tolerance=tolerance))
    status = main(["library", str(folder / "cell.toml"), "-o", str(folder / "axes.h5"), "--json"])
    told = capsys.readouterr()
    return status, json.loads(told.out) if status < 2 else told.err


def test_a_library_over_two_sizes_is_written_shown_and_right(tmp_path, capsys):
    status, told = made(tmp_path, capsys)
    assert status == 0
    assert told["failures"] == []
    assert told["usable"] == 1.0
    library = axes.load(tmp_path / "axes.h5")
    assert told["entries"] == library.t_error.size == 24 * 17  # 17 steps of 150/23 nm are more than the 110 nm along x
    assert np.diff(library.x_um) == pytest.approx(np.diff(library.y_um)[0])
    assert "cell.toml" in library.provenance.inputs
    i, j = 9, 17
    x, y = float(library.x_um[i]), float(library.y_um[j])
    exact = rcwa.jones(axes.sized(library.cell, x, y), x, 0.71, harmonics=told["harmonics"] + 3)
    assert np.abs(exact.t - library.t[0, i, j]).max() < library.t_error[0, i, j]
    assert (tmp_path / "axes.png").stat().st_size > 20_000
    panels = artefacts.axes_panels(tmp_path / "axes.h5")
    assert panels[1].values[1, 0, j, i] == pytest.approx(abs(library.t[0, i, j, 1, 1]))  # rows of the image: along y
    assert main(["view", str(tmp_path / "axes.h5"), "--quiet"]) == 0


def test_bars_above_the_tolerance_end_with_1_and_a_ratio_is_refused(tmp_path, capsys):
    status, told = made(tmp_path, capsys, tolerance=1e-5, longest=0.0801)
    assert status == 1
    assert "above the tolerance" in told["failures"][0]
    status, told = made(tmp_path, capsys, ratio="\nratio = 0.5")
    assert status == 2
    assert "leave ratio out" in told
