"""``metalens field``: what is asked for, written, drawn and said."""

import dataclasses

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Incidence
from metalens.cli import main
from metalens.commands import field
from metalens.core import store
from tests.command_line import call

CELL = """[cell]
pitch_um = 0.34
height_um = 0.41
pillar = { n = 2.4 }
[cell.lattice]
kind = "rectangular"
ratio = 1.25
[[cell.under]]
material = { n = 1.7 }
thickness_um = 0.06
[sweep]
wavelengths_um = [0.83]
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.toml").write_text(CELL)
    return tmp_path


FIRST = ["field", "cell.toml", "--diameter-um", "0.2"]
WORDS = [
    *FIRST,
    *("--samples", "12", "--angle-deg", "12"),
    *("--polarization", "y", "--tolerance", "0.5"),
]


def test_the_file_holds_the_fields_of_the_engine_on_square_pixels(here):
    assert call(*WORDS, "--heights-um 0.1 0.3 --around-um 0.2 --quiet") == 0
    stored = store.load(here / "field.h5", "near-field")
    held, step = stored.arrays, 0.34 / 12
    assert held["x_um"] == pytest.approx((np.arange(12) - 5.5) * step)
    assert held["y_um"] == pytest.approx((np.arange(15) - 7) * step)
    assert held["z_um"][:2] == pytest.approx([-0.26 + step / 2, -0.26 + 1.5 * step])
    assert abs(held["z_um"][-1] + step / 2 - 0.61) <= step
    assert held["xz/e"].shape == held["xz/h"].shape == (3, len(held["z_um"]), 12)
    assert held["yz/index"].shape == (len(held["z_um"]), 15)
    assert held["xy/e"].shape == (3, 2, 15, 12)
    cell = field.near_field_request(field.Options(here / "cell.toml", 0.2)).cell
    light = Incidence(0.83, np.radians(12.0), "y")
    grid = {"x_um": held["x_um"], "y_um": held["y_um"], "z_um": [0.1, 0.3]}
    same = rcwa.near_field(cell, 0.2, light, **grid, tolerance=0.5)
    # products of other widths: three planes
    assert abs(held["xy/h"] - same.h).max() < 1e-9 * np.abs(same.h).max()
    assert np.array_equal(held["xy/index"], same.index)
    assert stored.attributes["error_xy"] == pytest.approx(same.error, rel=1e-6)
    assert stored.attributes["wavelength_um"] == 0.83
    assert (here / "field.png").read_bytes()[:4] == b"\x89PNG"
    assert "angle_deg = 12.0" in stored.provenance.config
    assert list(stored.provenance.inputs) == ["cell.toml"]


def test_info_shows_it(here, capsys):
    assert call(*WORDS, "--quiet") == 0
    assert call("info field.h5") == 0
    assert "near-field version 1" in capsys.readouterr().out


def within(*errors):
    """A solver of few orders whose cuts and maps have these errors."""

    def found(*about, **how):
        made = rcwa.near_fields(*about, **{**how, "harmonics": 2})
        return [
            dataclasses.replace(one, error=error)
            for one, error in zip(made, errors, strict=True)
        ]

    return found


def test_a_bar_above_the_tolerance_is_a_failure(here, monkeypatch, capsys):
    monkeypatch.setattr(field, "near_fields", within(0.2, 0.49, 0.3))
    assert call(*WORDS[:-1], "1e-6") == 1
    told = capsys.readouterr().out
    assert (
        "FAILED: xz, yz, xy above the tolerance 1e-06 at 13 orders: allow a larger one; fields"
        in told
    )
    # none is stated: what is reached is told
    assert call(*WORDS[:-2], "--force") == 0
    told = capsys.readouterr().out
    assert (
        "  xz, yz, xy above the tolerance 0.1 at 13 orders: allow a larger one" in told
    )
    assert "FAILED" not in told


def test_a_field_that_is_not_known_within_half_is_a_failure_though_none_is_stated(
    here, monkeypatch, capsys
):
    monkeypatch.setattr(field, "near_fields", within(0.3, 0.51, 0.2))
    assert main(WORDS[:-2]) == 1
    assert (
        "FAILED: xz, yz, xy above the tolerance 0.1 at 13 orders: allow"
        in capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--tolerance 0.51", "tolerance = 0.51: need an error above 0 and up to 0.5"),
        ("--samples 7", "samples = 7: need 8 to 400"),
        ("--around-um -1", "around_um = -1"),
        ("--heights-um nan", "--heights-um nan: need a finite number"),
        ("--wavelength-nm 0", "wavelength_um = 0.0"),
        ("--angle-deg 90", "need finite angles"),
        ("--diameter-um 0.5", "touches its neighbour"),
    ],
)
def test_what_makes_no_field_is_refused(here, capsys, words, told):
    assert call(*FIRST, *words.split()) == 2
    assert told in capsys.readouterr().err
    assert not (here / "field.h5").exists()
