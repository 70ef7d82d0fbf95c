"""Materials: published values, smoothness of the interpolation, refusals that name line
and range.
"""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from metalens import materials
from metalens.cell.record import Blend, Index
from metalens.core.errors import MaterialError

ROUNDING = 1e-14  # of a few sums and products below 4: 4e-16 each


@pytest.mark.parametrize(
    ("wavelength_um", "want"),
    [(0.4861327, 1.46313), (0.5875618, 1.45846), (0.6562725, 1.45637)],
)
def test_fused_silica_at_the_fraunhofer_lines(wavelength_um, want):
    # catalogue values, five decimals
    assert abs(materials.index("SiO2", wavelength_um) - want) < 5.1e-6


@pytest.mark.parametrize(
    ("name", "wavelength_um", "want"),
    [
        ("a-Si", 0.8266, 3.86 + 0.0812j),
        ("a-Si", 1.033, 3.61),
        ("Si", 0.85, 3.641 + 3.6120e-3j),
        ("air", 0.85, 1),
    ],
)
def test_rows_of_the_sources_come_back(name, wavelength_um, want):
    assert abs(materials.index(name, wavelength_um) - want) < 1e-12


def test_plain_numbers_hold_at_every_wavelength():
    assert materials.index(Index(3.6, 0.1), 0.85) == 3.6 + 0.1j


@pytest.mark.parametrize(
    ("name", "wavelength_um"), [("a-Si", 2.07), ("Si", 0.2499), ("SiO2", 3.8)]
)
def test_outside_the_range_is_refused_and_the_range_is_named(name, wavelength_um):
    low, high = materials.find_material(name).range_um
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
    file.write_text(
        "# run 7, ellipsometer\nk, n, wavelength_um\n0.1,3.5,0.8\n\n0.0,3.3,0.9\n"
    )
    assert materials.index(str(file), 0.8) == 3.5 + 0.1j
    assert materials.find_material(str(file)).source == "run 7, ellipsometer"
    file.write_text("wavelength_um,n,k\n0.8,2,0\n0.9,2,0\n")
    # a file that changed is read again
    assert abs(materials.index(str(file), 0.85) - 2) < ROUNDING


@pytest.mark.parametrize("mark", [";", "\t"])
def test_a_table_with_decimal_commas_is_the_table_with_points(tmp_path: Path, mark):
    file = tmp_path / "ellipsometer.csv"
    text = "k|n|wavelength_um\n0,1|3,5|0,8\n0,05|3,25|0,9\n".replace("|", mark)
    file.write_bytes(("\ufeff" + text).encode("utf-8"))
    assert materials.index(str(file), 0.8) == 3.5 + 0.1j
    assert materials.index(str(file), 0.9) == 3.25 + 0.05j


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("wavelength_um,k\n0.8,3\n0.9,3\n", "no column n; need wavelength_um"),
        (
            "lambda,n\n0.8,3\n",
            "line 1: columns lambda, n; need wavelength_um .or wavelength_nm",
        ),
        ("wavelength_um,n,k\n0.8,3,0\n", "1 rows"),
        ("wavelength_um,n,k\n0.8,3,0\n0.9,x,0\n0.95,3,0\n", "line 3: .*need 3 finite"),
        ("wavelength_um,n,k\n# c\n0.8,3,0\n0.9,3\n1,3,0\n", "line 4: .*need 3 finite"),
        (
            "wavelength_um,n,k\n0.7,3,0\n0.8,3,0\n0.8,3.1,0\n0.9,3,0\n",
            "two rows at 0.8 um, .3.0, 0.0. and .3.1",
        ),
        (
            "wavelength_um,n,k\n0.8,3,0\n0.9,3,-2e-3\n1,3,0\n",
            "line 3: .*k of 0 or above",
        ),
        ("wavelength_um,n,k\n0.8,nan,0\n0.9,3,0\n1,3,0\n", "line 2: .*finite"),
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
def test_any_table_comes_back_at_its_rows_and_never_leaves_them_in_between(
    tmp_path_factory, rows
):
    rows = sorted(rows)
    file = tmp_path_factory.mktemp("nk") / "any.csv"
    file.write_text(
        "wavelength_um,n,k\n" + "".join(f"{w!r},{n!r},{k!r}\n" for w, n, k in rows)
    )
    record = materials.find_material(str(file))
    assert record.range_um == (rows[0][0], rows[-1][0])
    for w, n, k in rows:
        assert abs(materials.index(record, w) - complex(n, k)) < 1e-12 * (n + k)
    middle = materials.index(record, (rows[0][0] + rows[1][0]) / 2)
    assert (
        min(rows[0][2], rows[1][2]) * (1 - 1e-12)
        <= middle.imag
        <= max(rows[0][2], rows[1][2]) * (1 + 1e-12)
    )


@pytest.mark.parametrize(
    "name", ["Wavelength (nm)", '"wavelength, nm"', "wavelength_nm", "Wavelength [nm]"]
)
def test_a_table_that_falls_in_nanometres_is_the_table_that_rises(tmp_path: Path, name):
    file = tmp_path / "falls.csv"
    file.write_text(f"{name},k,n\n900,0.05,3.2\n840,0.02,3.5\n800,0.01,3.9\n")
    assert materials.index(str(file), 0.855) == pytest.approx(
        3.425 + 0.0275j, abs=1e-12
    )  # a quarter on from 840 nm
    assert materials.find_material(str(file)).range_um == pytest.approx((0.8, 0.9))


def test_missing_and_binary_files_are_refused(tmp_path: Path):
    with pytest.raises(MaterialError, match="no such file"):
        materials.index(str(tmp_path / "none.csv"), 0.85)
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(MaterialError, match="not a readable text file"):
        materials.index(str(tmp_path / "b.csv"), 0.85)


FORMULAS = [  # by hand at 0.6328 um, from the database's description of each formula
    (
        1,
        "0.1 0.7 0.09 0.4 9.0",
        lambda w: (
            (1.1 + 0.7 * w**2 / (w**2 - 0.0081) + 0.4 * w**2 / (w**2 - 81)) ** 0.5
        ),
    ),
    (2, "0.1 0.7 0.09", lambda w: (1.1 + 0.7 * w**2 / (w**2 - 0.09)) ** 0.5),
    (3, "2.2 0.01 2 0.02 -2", lambda w: (2.2 + 0.01 * w**2 + 0.02 / w**2) ** 0.5),
    (
        4,
        "2.1 0.03 0 0.2 2 0.01 2 0.3 1 -0.01 2",
        lambda w: (
            (2.1 + 0.03 / (w**2 - 0.04) + 0.01 * w**2 / (w**2 - 0.3) - 0.01 * w**2)
            ** 0.5
        ),
    ),
    (5, "1.5 0.004 -2 0.0002 -4", lambda w: 1.5 + 0.004 / w**2 + 0.0002 / w**4),
    (
        6,
        "0.0 0.05 230 0.002 57",
        lambda w: 1 + 0.05 / (230 - w**-2) + 0.002 / (57 - w**-2),
    ),
    (
        7,
        "3.4 0.15 -0.02 -0.001 0.0002 0.00003",
        lambda w: (
            3.4
            + 0.15 / (w**2 - 0.028)
            - 0.02 / (w**2 - 0.028) ** 2
            - 0.001 * w**2
            + 0.0002 * w**4
            + 0.00003 * w**6
        ),
    ),
    (
        8,
        "0.3 0.05 0.03 -0.002",
        lambda w: (
            (
                (1 + 2 * (0.3 + 0.05 * w**2 / (w**2 - 0.03) - 0.002 * w**2))
                / (1 - (0.3 + 0.05 * w**2 / (w**2 - 0.03) - 0.002 * w**2))
            )
            ** 0.5
        ),
    ),
    (
        9,
        "2.5 0.01 0.02 0.003 1.5 0.9",
        lambda w: (
            (2.5 + 0.01 / (w**2 - 0.02) + 0.003 * (w - 1.5) / ((w - 1.5) ** 2 + 0.9))
            ** 0.5
        ),
    ),
]


@pytest.mark.parametrize(
    ("number", "coefficients", "plain"),
    FORMULAS,
    ids=[f"formula {f[0]}" for f in FORMULAS],
)
def test_every_formula_of_the_database(tmp_path: Path, number, coefficients, plain):
    page = tmp_path / "page.yml"
    page.write_text(
        f"REFERENCES: |\n    A. <i>B</i>\nDATA:\n  - type: formula {number}\n    wavelength_range: 0.4 0.9\n"
        f"    coefficients: {coefficients}\n"
    )
    w = 0.6328
    assert abs(materials.index(str(page), w) - plain(w)) < 1e-13
    assert materials.find_material(str(page)).source == "A. B"
    with pytest.raises(MaterialError, match=r"from 0.4 to 0.9 um"):
        materials.index(str(page), 0.95)


@pytest.mark.parametrize("count", [5, 9])
def test_a_rational_formula_ends_after_a_term_and_holds_where_an_absent_pole_would_lie(
    tmp_path: Path, count
):
    """c^0 = 1 of a term that is not there is no pole at 1 um."""
    c = (2.25, 0.4, 0.3, 0.2, 2.0, 0.01, 0.5, 0.3, 3.0)[:count]
    page = tmp_path / "page.yml"
    words = " ".join(map(str, c))
    page.write_text(
        f"DATA:\n  - type: formula 4\n    wavelength_range: 0.8 1.2\n    coefficients: {words}\n"
    )
    square = 2.25 + 0.4 / (1 - 0.2**2) + (0.01 / (1 - 0.3**3) if count > 5 else 0)
    assert materials.index(str(page), 1.0) == pytest.approx(
        math.sqrt(square), rel=1e-12
    )


def test_noise_of_a_measured_k_below_nothing_is_no_gain(tmp_path: Path):
    """Ellipsometry has k to 1e-3; what is farther below 0 is the other sign of time."""
    page = tmp_path / "noisy.yml"
    page.write_text(
        "DATA:\n  - type: tabulated nk\n    data: |\n        0.5 1.4 -8e-4\n        0.6 1.5 2e-3\n"
    )
    assert materials.index(str(page), 0.5) == pytest.approx(1.4, abs=ROUNDING)
    assert materials.index(str(page), 0.6) == pytest.approx(1.5 + 2e-3j, abs=ROUNDING)


def test_formula_with_a_table_of_k_holds_where_both_do(tmp_path: Path):
    page = tmp_path / "page.yaml"
    page.write_text(
        "DATA:\n  - type: formula 5\n    wavelength_range: 0.3 2.0\n    coefficients: 1.5 0.01 -2\n"
        "  - type: tabulated k\n    data: |\n        0.9 3e-3\n        0.5 1e-3\n"
    )
    assert (
        abs(materials.index(str(page), 0.6) - (1.5 + 0.01 / 0.36 + 1.5e-3j)) < ROUNDING
    )  # rows in any order
    assert materials.find_material(str(page)).range_um == (0.5, 0.9)


@pytest.mark.parametrize("name", materials.NAMES)
def test_every_shipped_material_says_its_source_and_is_a_material(name):
    record = materials.find_material(name)
    low, high = record.range_um
    for share in (0.01, 0.37, 0.83):
        n = materials.index(name, low + share * (min(high, 20.0) - low))
        assert n.real > 0
        assert n.imag >= 0
    assert len(record.source) > 15


@pytest.mark.parametrize(
    ("name", "wavelength_um", "want", "off"),
    [
        (
            "sapphire",
            0.5893,
            1.7682,
            2e-4,
        ),  # handbooks: no = 1.768, ne = 1.760 at the sodium line
        ("sapphire-e", 0.5893, 1.7600, 2e-4),
        ("N-BK7", 0.5875618, 1.51680, 1e-5),  # catalogue nd
        ("MgF2", 0.5893, 1.3777, 1e-4),
        ("CaF2", 0.5893, 1.43384, 5e-5),
        ("PMMA", 0.5893, 1.4914, 2e-3),  # samples differ by that much
    ],
)
def test_shipped_materials_against_handbook_values(name, wavelength_um, want, off):
    assert abs(materials.index(name, wavelength_um).real - want) < off


@pytest.mark.parametrize(
    ("name", "want"),
    [
        ("titania", "TiO2"), ("gold", "Au"), ("silicon", "Si"), ("Titanium dioxide", "TiO2"), ("fused_silica", "SiO2"),
        ("GaN-o", "GaN"), ("Al2O3-e", "sapphire-e"), ("PC", "polycarbonate"),
    ],
)  # fmt: skip
def test_a_word_leads_to_the_material(name, want):
    with pytest.raises(MaterialError, match=f"did you mean '{want}'"):
        materials.index(name, 0.6)


def test_tables_without_k_in_nanometres_and_with_k_below_n(tmp_path: Path):
    file = tmp_path / "n.csv"
    file.write_text("wavelength_nm,n\n800,2.0\n900,2.2\n")
    assert abs(materials.index(str(file), 0.85) - 2.1) < 1e-12
    file = tmp_path / "stacked.csv"
    file.write_text("wl,n\n0.8,2.0\n0.9,2.2\n\nwl,k\n0.8,0.02\n0.9,0.04\n")
    assert abs(materials.index(str(file), 0.85) - (2.1 + 0.03j)) < 1e-12


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("just text", "no list DATA"),
        (
            "DATA:\n  - type: formula 12\n    wavelength_range: 0.4 0.9\n    coefficients: 1 2 3\n",
            "formula 1 to 9",
        ),
        (
            "DATA:\n  - type: formula 1\n    wavelength_range: 0.4 0.9\n    coefficients: 1 x 3\n",
            "not numbers",
        ),
        ("DATA:\n  - type: tabulated nk\n    data: |\n        0.5 1.5\n", "row 1"),
        ("DATA: [", "not YAML"),
        ("DATA: " + "[" * 3000, "not YAML"),
        ("DATA: 2001-99-99", "not YAML"),
        ("DATA: " + "9" * 5000, "not YAML"),
        ("DATA:\n  - x\n", "entry 1 of DATA is no table"),
        ("DATA:\n  - type: [formula, 1]\n    data: 3\n", "neither a formula"),
        (
            "DATA:\n  - type: tabulated k\n    data: |\n        0.5 0.1\n        0.6 0.1\n",
            "neither a formula",
        ),
        (
            "DATA:\n  - type: tabulated n2\n    data: |\n        0.5 1e-19\n        0.6 1e-19\n",
            "need tabulated nk, n or k",
        ),
        (
            "DATA:\n  - type: tabulated nk\n    data: |\n        0.5 0.2 -3.1\n        0.6 0.3 -3.4\n",
            "k = -3.4; need k",
        ),
        (
            "DATA:\n  - type: tabulated nk\n    data: |\n        0.5 1.4 1e-4\n        0.6 1.5 -1.5e-3\n",
            "k = -0.0015; need k",
        ),
        (
            "DATA:\n  - type: tabulated n\n    data: |\n        0.5 1.4\n        0.6 -1.5\n",
            "n = -1.5; need n",
        ),
        (
            "DATA:\n  - type: formula 5\n    wavelength_range: 0.4 0.9\n    coefficients: 1.5 0.01 -2\n"
            "  - type: tabulated n\n    data: |\n        0.5 1.4\n        0.6 1.5\n",
            "entry 2 of DATA gives n a second time",
        ),
        *(
            (
                f"DATA:\n  - type: formula {i}\n    wavelength_range: 0.4 0.9\n    coefficients: {'1.3 ' * n}\n",
                "whole term",
            )
            for i, n in [
                (1, 4),
                (2, 6),
                (3, 4),
                (4, 6),
                (4, 7),
                (4, 8),
                (5, 4),
                (6, 4),
                (7, 7),
                (8, 5),
                (9, 7),
            ]
        ),
    ],
)
def test_a_bad_page_is_refused(tmp_path: Path, text, message):
    file = tmp_path / "bad.yml"
    file.write_text(text)
    with pytest.raises(MaterialError, match=message):
        materials.index(str(file), 0.55)


def test_blends_and_offsets():
    """Bruggeman's equation holds for what comes out; ends of the share are the
    materials themselves.
    """
    a = materials.index("TiO2", 0.6) ** 2
    b = materials.index("SiO2", 0.6) ** 2
    e = materials.index(Blend("TiO2", "SiO2", 0.3), 0.6) ** 2
    assert abs(0.7 * (a - e) / (a + 2 * e) + 0.3 * (b - e) / (b + 2 * e)) < 1e-12
    assert abs(materials.index(Blend("TiO2", "SiO2", 1.0), 0.6) ** 2 - b) < 1e-12
    shifted = materials.index(Blend("TiO2", n_offset=-0.07, k_offset=0.002), 0.6)
    assert abs(shifted - (materials.index("TiO2", 0.6) - 0.07 + 0.002j)) < ROUNDING


def write_page(folder: Path, rows: list[str]) -> str:
    """A page with one table of n and k; its path."""
    file = folder / "page.yml"
    data = "".join(f"        {row}\n" for row in rows)
    file.write_text(f"DATA:\n  - type: tabulated nk\n    data: |\n{data}")
    return str(file)


def test_a_bad_row_of_a_page_spoils_the_wavelengths_beside_it_alone(tmp_path: Path):
    rows = ["0.4 2.0 0.5", "0.5 1.8 -0.003", "0.6 1.6 0.1", "0.9 1.3 0.1"]
    page = write_page(tmp_path, rows)
    assert materials.index(page, 0.75) == pytest.approx(1.45 + 0.1j, abs=1e-15)
    assert materials.index(page, 0.6) == 1.6 + 0.1j
    assert materials.index(page, 0.4) == 2.0 + 0.5j
    for wavelength_um in (0.41, 0.5, 0.59):
        with pytest.raises(MaterialError, match=r"row 2: '0.5 1.8 -0.003'.*k = -0.003"):
            materials.index(page, wavelength_um)


@pytest.mark.parametrize("row", ["0.5 1.8 x", "0.5 1.8", "0.5 nan 0.1", "0.5 -1.8 0.1"])
def test_a_row_that_is_no_index_is_named_where_it_is_asked_for(tmp_path: Path, row):
    page = write_page(tmp_path, ["0.9 1.3 0.1", "0.6 1.6 0.1", row, "0.4 2.0 0.5"])
    assert materials.index(page, 0.75) == pytest.approx(1.45 + 0.1j, abs=1e-15)
    with pytest.raises(MaterialError, match=r"row 3: .*0\.47 um"):
        materials.index(page, 0.47)
