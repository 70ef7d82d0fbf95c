"""Materials: published values, smoothness of the interpolation, refusals that name line and range."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from metalens import materials
from metalens.cell import Index
from metalens.errors import MaterialError


@pytest.mark.parametrize(("wavelength_um", "want"), [(0.4861327, 1.46313), (0.5875618, 1.45846), (0.6562725, 1.45637)])
def test_fused_silica_at_the_fraunhofer_lines(wavelength_um, want):
    assert abs(materials.index("SiO2", wavelength_um) - want) < 5.1e-6  # catalogue values, five decimals


@pytest.mark.parametrize(
    ("name", "wavelength_um", "want"),
    [("a-Si", 0.8266, 3.86 + 0.0812j), ("a-Si", 1.033, 3.61), ("Si", 0.85, 3.641 + 3.6120e-3j), ("air", 0.85, 1)],
)
def test_rows_of_the_sources_come_back(name, wavelength_um, want):
    assert abs(materials.index(name, wavelength_um) - want) < 1e-12


@given(st.sampled_from(["a-Si", "Si"]), st.floats(0.32, 1.44))
def test_between_rows_the_table_is_a_straight_line(name, wavelength_um):
    w, n, k = materials.material(name).table
    want = np.interp(wavelength_um, w, n) + 1j * np.interp(wavelength_um, w, k)
    assert abs(materials.index(name, wavelength_um) - want) < 1e-12
    row = w[np.argmin(np.abs(w - wavelength_um))]
    chord = (materials.index(name, row) - materials.index(name, wavelength_um)) / (row - wavelength_um or 1)
    rate = materials.slope(name, wavelength_um)
    assert row == wavelength_um or abs(chord - rate) < 1e-12 / abs(row - wavelength_um) + 1e-12 * abs(rate)


@given(st.floats(0.22, 3.7))
def test_slope_of_the_sellmeier_formula(wavelength_um):
    step = 1e-5
    rise = materials.index("SiO2", wavelength_um + step) - materials.index("SiO2", wavelength_um - step)
    rate = materials.slope("SiO2", wavelength_um)
    assert abs(rise / (2 * step) - rate) < 1e-4 * abs(rate) + 1e-9  # third derivative / 6 step^2, and rounding


@given(st.floats(0.31, 2.066))
def test_absorption_is_never_negative(wavelength_um):
    assert materials.index("a-Si", wavelength_um).imag >= 0


def test_plain_numbers_hold_at_every_wavelength():
    assert materials.index(Index(3.6, 0.1), 0.85) == 3.6 + 0.1j
    assert materials.slope(Index(3.6, 0.1), 0.85) == 0


@pytest.mark.parametrize(("name", "wavelength_um"), [("a-Si", 2.07), ("Si", 0.2499), ("SiO2", 3.8)])
def test_outside_the_range_is_refused_and_the_range_is_named(name, wavelength_um):
    low, high = materials.material(name).range_um
    with pytest.raises(MaterialError, match=rf"{name} at .*from {low} to {high} um"):
        materials.index(name, wavelength_um)


@pytest.mark.parametrize("wavelength_um", [0.0, -1.0, math.nan, math.inf])
def test_a_wavelength_that_is_no_length_is_refused(wavelength_um):
    with pytest.raises(MaterialError, match="need a finite length above 0"):
        materials.index("air", wavelength_um)


def test_a_misspelt_name_gets_the_nearest_one():
    with pytest.raises(MaterialError, match="did you mean 'SiO2'"):
        materials.index("SiO3", 0.85)


def test_own_table_with_shuffled_columns_and_comments(tmp_path: Path):
    file = tmp_path / "mine.csv"
    file.write_text("# run 7, ellipsometer\nk, n, wavelength_um\n0.1,3.5,0.8\n\n0.0,3.3,0.9\n")
    assert materials.index(str(file), 0.8) == 3.5 + 0.1j
    assert materials.material(str(file)).source == "run 7, ellipsometer"
    file.write_text("wavelength_um,n,k\n0.8,2,0\n0.9,2,0\n")
    assert abs(materials.index(str(file), 0.85) - 2) < 1e-15  # a file that changed is read again


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("wavelength_um,n\n0.8,3\n", "line 1: no column k"),
        ("wavelength_um,n,k\n0.8,3,0\n", "1 rows"),
        ("wavelength_um,n,k\n0.8,3,0\n0.9,x,0\n", "line 3: .* not numbers"),
        ("wavelength_um,n,k\n# c\n0.8,3,0\n0.9,3\n", "line 4: 2 fields"),
        ("wavelength_um,n,k\n0.8,3,0\n0.7,3,0\n", "line 3: wavelength 0.7 um follows 0.8"),
        ("wavelength_um,n,k\n0.8,3,0\n0.9,3,-1e-3\n", "line 3: .*k >= 0"),
        ("wavelength_um,n,k\n0.8,nan,0\n0.9,3,0\n", "line 2: .*finite"),
    ],
)
def test_a_bad_table_is_refused_with_its_line(tmp_path: Path, text, message):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(MaterialError, match=message):
        materials.index(str(file), 0.85)


@given(
    st.lists(
        st.tuples(st.floats(0.2, 20.0), st.floats(1e-3, 10.0), st.floats(0.0, 20.0)),
        min_size=2,
        max_size=20,
        unique_by=lambda row: row[0],
    )
)
def test_any_table_comes_back_at_its_rows_and_never_leaves_them_in_between(tmp_path_factory, rows):
    rows = sorted(rows)
    file = tmp_path_factory.mktemp("nk") / "any.csv"
    file.write_text("wavelength_um,n,k\n" + "".join(f"{w!r},{n!r},{k!r}\n" for w, n, k in rows))
    record = materials.read_csv(file)
    assert record.range_um == (rows[0][0], rows[-1][0])
    for w, n, k in rows:
        assert abs(materials.index(record, w) - complex(n, k)) < 1e-12 * (n + k)
    middle = materials.index(record, (rows[0][0] + rows[1][0]) / 2)
    assert min(rows[0][2], rows[1][2]) * (1 - 1e-12) <= middle.imag <= max(rows[0][2], rows[1][2]) * (1 + 1e-12)


def test_missing_and_binary_files_are_refused(tmp_path: Path):
    with pytest.raises(MaterialError, match="no such file"):
        materials.index(str(tmp_path / "none.csv"), 0.85)
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(MaterialError, match="not a readable text file"):
        materials.index(str(tmp_path / "b.csv"), 0.85)
