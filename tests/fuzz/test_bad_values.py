"""Every key of every settings file with every value that it should not have: refused by
file and key, none computes.
"""

import functools
import typing

import pytest

from benchmarks import _hardness_values as matrix

# what may be below 0: turns and offsets either way, sections narrower than their mask,
# parameters of a made lens, a
# stage that runs backwards
SIGNED = {"n_offset", "k_offset", "angle_rad", "strength_rad", "isolated_nm", "sidewall_deg", "value", "step_um",
          "elevation_deg", "angle_deg", "gaze_step_deg", "slip_step_mm", "mask_turn_deg", "grow_um",
          "turn_deg", "x_um", "y_um", "x_mm", "y_mm"}  # fmt: skip
# a measure of these has no meaning at 0
ABOVE_ZERO = (
    "tolerance",
    "wavelength",
    "pitch_um",
    "aperture",
    "pixel_um",
    "samples",
    "window",
    "frames",
)


@pytest.fixture(scope="module")
def trials():
    """All of them; kinds of a record's keys are worked out once and not for each of ten
    thousand.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typing, "get_type_hints", functools.cache(typing.get_type_hints))
        return list(matrix.trials())


def _taken(trials, *values):
    return {(t.settings, t.key) for t in trials if t.value in values and not t.said}


def _leaves(taken):
    return {key.rpartition(".")[2] for _, key in taken}


def test_no_refusal_is_untyped_and_each_names_file_and_key(trials):
    assert len(trials) > 10_000
    assert [t for t in trials if not t.typed] == []
    assert [t for t in trials if t.said and not t.names_it] == []
    assert max(len(t.said) for t in trials) < 900


def test_no_number_out_of_this_world_is_taken(trials):
    assert _taken(trials, "nan", "-inf", "1e20", "2^100", "5000 digits") == set()
    assert _leaves(_taken(trials, "inf")) == {"source_distance_mm"}  # a collimated beam
    assert _leaves(_taken(trials, "2^60")) == {"seed"}


def test_below_zero_is_taken_only_where_it_means_something(trials):
    assert _leaves(_taken(trials, "-1", "-1.5")) <= SIGNED
    zero = _leaves(_taken(trials, "0"))
    assert not [key for key in zero if key.startswith(ABOVE_ZERO)]


def test_nothing_of_another_kind_is_taken(trials):
    assert _taken(trials, "table", "deep", "NUL", "control", "lists", "mixed") == set()
    assert _taken(trials, "empty") == {  # no label, the only top cell
        ("process", "die.label"),
        ("arrangement", "die.label"),
        ("arrangement", "cell[].cell"),
        ("arrangement", "into.cell"),
    }
    hints = _leaves(_taken(trials, "true"))
    assert hints == {
        "hole",
        "add_focus",
        "conjugate",
        "budget",
        "own_cell",
        "furnished",
        "checked",
        "verniers",
        "mirrored",
    }


def test_what_is_good_is_taken():
    for record, table in matrix.roots().values():
        assert matrix.config.from_table(table, record) is not None
