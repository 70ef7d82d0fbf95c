"""Unit-cell tables of other solvers: the same response in every form that they write.

The response is a closed form: phase 2.1 turns over the sizes, power falling from 0.98.
"""

import math

import numpy as np
import pytest

from metalens import library
from metalens.cell import Cell
from metalens.core.errors import DomainError
from tests.command_line import call

CELL = Cell(pitch_um=0.31)
SIZE_NM = np.linspace(70.0, 220.0, 40)
SHARE = (SIZE_NM - 70.0) / 150.0
PHASE_RAD = 2 * math.pi * (0.3 + 1.2 * SHARE**2 + 0.1 * SHARE)
POWER = 0.98 - 0.11 * SHARE
T = np.sqrt(POWER) * np.exp(1j * PHASE_RAD)


def _close(made: library.PillarLibrary) -> None:
    assert made.diameter_um == pytest.approx(SIZE_NM * 1e-3, abs=1e-9)
    assert made.wavelength_um == pytest.approx([0.94], rel=1e-9)
    np.testing.assert_allclose(made.t[0, 0, 0], T, atol=1e-12)


FORMS = {
    "power and degrees": {
        "diameter_nm": SIZE_NM,
        "phase_deg": np.degrees(PHASE_RAD),
        "transmission": POWER,
    },
    "other time factor, wrapped, radius": {
        "Radius (um)": SIZE_NM * 5e-4,
        "Phase (rad)": np.angle(np.exp(-1j * PHASE_RAD)),
        "T": POWER,
    },
    "turns and amplitude": {
        "size [m]": SIZE_NM * 1e-9,
        "phi_turns": PHASE_RAD / (2 * math.pi),
        "|t|": np.sqrt(POWER),
    },
    "S-parameter": {"width_nm": SIZE_NM, "S21_re": T.real, "S21_im": T.imag},
    "decibels of CST": {
        "Diameter [nm]": SIZE_NM,
        "S21 [dB]": 10 * np.log10(POWER),
        "arg(S21) [deg]": np.degrees(PHASE_RAD),
    },
    "complex": {"d_nm": SIZE_NM, "t": T},
}


@pytest.mark.parametrize("form", FORMS)
def test_one_response_in_every_form_is_one_library(form):
    order = np.random.default_rng(5).permutation(len(SIZE_NM))
    shuffled = {name: values[order] for name, values in FORMS[form].items()}
    _close(library.from_table(shuffled, CELL, wavelength_um=0.94))


def test_a_text_export_of_comsol_is_read(tmp_path):
    lines = [
        "% Model:    cell.mph",
        "% Version:  COMSOL 6.1",
        "% r (nm)   ewfd.S21 (1)",
    ]
    lines += [
        f"{size / 2:<22.10g}{t.real:.12f}{t.imag:+.12f}i"
        for size, t in zip(SIZE_NM, T.conj(), strict=True)  # exp(+iwt)
    ]
    (tmp_path / "table.txt").write_text("\n".join(lines))
    made = library.from_table(tmp_path / "table.txt", CELL, wavelength_um=0.94)
    np.testing.assert_allclose(made.t[0, 0, 0], T, atol=1e-11)


def test_an_array_over_sizes_and_wavelengths_has_one_column_for_each_axis():
    lights = np.array([0.9, 0.94, 1.0])
    grid = T[:, None] * np.exp(0.1j * np.arange(3))
    table = {"diameter_nm": SIZE_NM, "wavelength_um": lights[None], "t": grid}
    made = library.from_table(table, CELL)
    assert made.wavelength_um == pytest.approx(lights)
    np.testing.assert_allclose(made.t[0, 0], grid.T, atol=1e-12)


def test_frequencies_and_angles_span_a_grid():
    terahertz, degrees = [318.9281468085106, 299.792458], [0.0, 12.5]
    rows = [
        (f, a, d, p + 0.2 * i + 0.05 * j, w)
        for i, f in enumerate(terahertz)
        for j, a in enumerate(degrees)
        for d, p, w in zip(SIZE_NM, PHASE_RAD, POWER, strict=True)
    ]
    names = ("frequency_THz", "angle_deg", "diameter_nm", "phase_rad", "transmission")
    made = library.from_table(dict(zip(names, np.array(rows).T, strict=True)), CELL)
    assert made.wavelength_um == pytest.approx([0.94, 1.0])
    assert made.angle_rad == pytest.approx(np.radians(degrees))
    assert made.t.shape == (2, 2, 2, 40)
    expected = T * np.exp(0.05j)  # the first frequency is the shorter wavelength
    np.testing.assert_allclose(made.t[1, 1, 0], expected, atol=1e-12)


def test_left_out_bars_see_a_wrong_entry_and_a_stated_bar_is_kept():
    wrong = PHASE_RAD.copy()
    wrong[17] += 0.02
    table = FORMS["power and degrees"] | {"phase_deg": np.degrees(wrong)}
    made = library.from_table(table, CELL, wavelength_um=0.94)
    assert made.t_error[0, 0, 0, 17] >= 0.9 * 0.02 * abs(T[17])
    bars = np.linspace(0.001, 0.004, len(SIZE_NM))
    stated = library.from_table(table | {"t_error": bars}, CELL, wavelength_um=0.94)
    assert stated.t_error[0, 0, 0] == pytest.approx(bars)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"diameter": SIZE_NM, "diameter_nm": None}, "states no unit"),
        ({"colour": SIZE_NM}, "'colour' is unknown"),
        ({"transmission": None}, "need phase with"),
        ({"transmission": 1.4 * POWER}, "normalised to power"),
        ({"transmission": np.where(SHARE > 0.5, np.nan, POWER)}, "not finite"),
        ({"t": T}, "two columns of"),
    ],
)
def test_what_cannot_be_a_table_is_refused_with_the_cure(change, word):
    table = FORMS["power and degrees"] | change
    table = {name: values for name, values in table.items() if values is not None}
    if word == "two columns of":
        table["T"] = POWER
    with pytest.raises(DomainError, match=word):
        library.from_table(table, CELL, wavelength_um=0.94)


def test_a_missing_entry_of_the_grid_is_named():
    rows = {"wavelength_um": np.repeat([0.8, 0.94], 40)} | {
        name: np.tile(values, 2) for name, values in FORMS["power and degrees"].items()
    }
    cut = {name: np.delete(values, 43) for name, values in rows.items()}
    with pytest.raises(DomainError, match=r"1 entries are missing.*0\.94 um"):
        library.from_table(cut, CELL)


@pytest.mark.parametrize(("mark", "point"), [(",", "."), (";", ","), ("\t", ".")])
def test_the_command_takes_a_table_to_a_lens(tmp_path, mark, point, capsys):
    (tmp_path / "cell.toml").write_text(
        "[cell]\npitch_um = 0.31\n[sweep]\nwavelengths_um = [0.94]\n"
    )
    rows = [mark.join(["Diameter (nm)", "Phase (deg)", "Transmission"])]
    rows += [
        mark.join(f"{v:.9f}".replace(".", point) for v in row)
        for row in zip(SIZE_NM, np.degrees(PHASE_RAD), POWER, strict=True)
    ]
    (tmp_path / "table.csv").write_text("\n".join(rows) + "\n")
    words = f"{tmp_path}/table.csv --cell {tmp_path}/cell.toml"
    out = tmp_path / "library.h5"
    assert call(f"library {words} -o {out}") == 0
    assert "share of power" in capsys.readouterr().out
    made = library.load(out)
    np.testing.assert_allclose(made.t[0, 0, 0], T, atol=1e-6)
    proxy = library.proxy_of(made)
    turns = (
        (proxy.phase_rad(0.15, 0.94) - np.interp(150, SIZE_NM, PHASE_RAD)) / 2 / math.pi
    )
    assert abs(turns - round(float(turns))) < 0.01
