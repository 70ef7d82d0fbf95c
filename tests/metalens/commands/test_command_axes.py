"""``metalens library`` over two sizes: what is said, written and shown; failures of the
result end with 1.
"""

import dataclasses
import json

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Cell
from metalens.commands import library as library_command
from metalens.library import Sweep, axes
from metalens.view import artefacts
from tests.command_line import call

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
lengths_um = [0.08, 0.23]
samples = 24
tolerance = 0.1
"""


def made(folder, capsys, *, ratio=""):
    (folder / "cell.toml").write_text(CELL.format(ratio=ratio))
    status = call(f"library {folder}/cell.toml -o {folder}/axes.h5 --json")
    told = capsys.readouterr()
    return status, json.loads(told.out) if status < 2 else told.err


def test_a_library_over_two_sizes_is_written_shown_and_right(
    tmp_path, capsys, fine_pictures
):
    status, told = made(tmp_path, capsys)
    assert status == 0
    assert told["failures"] == []
    assert told["usable"] == 1.0
    library = axes.load_axes_library(tmp_path / "axes.h5")
    # 17 steps of 150/23 nm are more than the 110 nm along x
    assert told["entries"] == library.t_error.size == 24 * 17
    assert np.diff(library.x_um) == pytest.approx(np.diff(library.y_um)[0])
    assert "cell.toml" in library.provenance.inputs
    i, j = 9, 17
    x, y = float(library.x_um[i]), float(library.y_um[j])
    exact = rcwa.jones(
        axes.cell_of_sizes(library.cell, x, y), x, 0.71, harmonics=told["harmonics"] + 3
    )
    assert abs(exact.t - library.t[0, i, j]).max() < library.t_error[0, i, j]
    panels = artefacts.axes_panels(tmp_path / "axes.h5")
    # rows of the image: along y
    assert panels[1].values[1, 0, j, i] == pytest.approx(abs(library.t[0, i, j, 1, 1]))
    assert call(f"view {tmp_path}/axes.h5 --quiet") == 0


def test_bars_above_the_tolerance_fail_and_a_ratio_is_refused(tmp_path, capsys):
    axis = np.array([0.1, 0.11, 0.12])
    sweep = Sweep(
        (0.7,), diameters_um=(0.1, 0.12), lengths_um=(0.1, 0.12), tolerance=0.03
    )
    bars = np.array([0.02, 0.04, 0.05])[None, :, None] * np.ones((1, 3, 3))
    held = np.array([[0, 0.1, 0.11, 0.021, 0.02], [0, 0.11, 0.1, 0.001, 0.04]])
    t = np.ones((1, 3, 3, 2, 2), complex)
    found = axes.AxesLibrary(
        Cell(0.3), sweep, np.array([0.7]), axis, axis, t, bars, held, 9, 5
    )
    assert [
        line.split(":")[0] for line in library_command.two_size_failures(found)
    ] == [
        "error bars of 67% of the pairs of sizes are above the tolerance 0.03 (median 0.04)",
        "1 of 2 pairs held out lie above their error bar",
    ]
    assert (
        library_command.two_size_failures(
            dataclasses.replace(found, t_error=bars / 2, held_out=held[1:])
        )
        == []
    )
    status, told = made(tmp_path, capsys, ratio="\nratio = 0.5")
    assert status == 2
    assert "leave ratio out" in told
