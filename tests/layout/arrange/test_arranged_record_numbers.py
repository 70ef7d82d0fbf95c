"""What an arrangement may say: how many copies, which doses, and which lenses bring
furniture of their own.
"""

from pathlib import Path

import pytest

from layout.arrange import record
from layout.arrange.record import (
    Arrangement,
    At,
    CellPart,
    Furniture,
    Into,
    LensPart,
    Wafer,
)
from metalens.ground import config
from metalens.ground.errors import ConfigError, ProcessError


def test_a_million_copies_are_the_most():
    assert (
        At(columns=1250, rows=800, step_um=(3.0, 4.0)).columns * 800
        == record.MOST_DIES
        == 1_000_000
    )
    with pytest.raises(ProcessError, match="columns x rows = 1 x 1000001"):
        At(rows=1_000_001, step_um=(3.0, 4.0))
    assert (At().columns, At().rows, At(x_um=-3.0, y_um=-4.0).step_um) == (1, 1, None)


@pytest.mark.parametrize(
    ("die", "into", "told", "own"),
    [
        (False, False, None, True),
        (True, False, None, False),
        (False, True, None, False),
        (True, False, True, True),
        (False, False, False, False),
        (False, True, True, True),
    ],
)
def test_a_lens_is_furnished_where_nothing_else_is_unless_it_says_so(
    die, into, told, own
):
    part = LensPart(Path("lens.h5"), "L", told)
    made = Arrangement(
        lens=(part,),
        die=Furniture((900.0, 700.0)) if die else None,
        into=Into(Path("chip.gds")) if into else None,
    )
    assert made.furnished(part) is own


TEXT = """
[[lens]]
file = "a.h5"
name = "L"
[[lens.at]]
x_um = -3.5
y_um = -0.25
[[cell]]
file = "b.gds"
name = "C"
relative_dose = {dose}
[wafer]
pitch_um = [5000.0, 3000.0]
[[wafer.marks]]
x_mm = -3.0
y_mm = -0.5
"""


def test_a_file_may_hold_places_of_either_sign_and_doses_above_nothing(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(TEXT.format(dose=0.03))
    made = config.load(path, Arrangement)
    assert (made.lens[0].at[0].x_um, made.lens[0].at[0].y_um) == (-3.5, -0.25)
    assert (made.wafer.marks[0].x_mm, made.wafer.marks[0].y_mm) == (-3.0, -0.5)
    assert made.cell[0].relative_dose == 0.03
    path.write_text(TEXT.format(dose=0.0))
    with pytest.raises(ConfigError, match="relative_dose"):
        config.load(path, Arrangement)
    path.write_text(
        '[[lens]]\nfile = "a.h5"\nname = "L"\n[into]\nfile = "c.gds"\nrelative_dose = 0.04\n'
    )
    assert config.load(path, Arrangement).into.relative_dose == 0.04


def test_a_wafer_s_shares_are_those_of_the_docstrings():
    made = Wafer((5000.0, 3000.0))
    assert (
        made.diameter_mm,
        made.edge_exclusion_mm,
        made.mark_um,
        made.mark_width_um,
    ) == (100.0, 3.0, 400.0, 20.0)
    assert (
        CellPart(Path("b.gds"), "C").relative_dose,
        Into(Path("c.gds")).relative_dose,
    ) == (1.0, 1.0)
    assert LensPart(Path("lens.h5"), "TWELVE_CHARS").at == (At(),)
    with pytest.raises(ProcessError, match="at most 12 characters"):
        LensPart(Path("lens.h5"), "THIRTEEN_CHAR")
