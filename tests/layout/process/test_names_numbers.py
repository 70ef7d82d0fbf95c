"""Names of 1 to 32 characters, and the nearest legal one."""

import re

import pytest

from layout.process import names
from metalens.core.errors import ProcessError


def test_names_have_one_to_thirty_two_characters():
    longest = "ABCDEFGHIJKLMNOPQRSTUVWXYZ_$0123"
    assert names.LONGEST == len(longest) == 32
    assert [names.check_cell_name(name) for name in (longest, "z")] == [longest, "z"]
    for bad in ("", longest + "4", "A B", "Ä", "A-1"):
        with pytest.raises(ProcessError, match="need 1 to 32 of A-Z a-z 0-9 _ \\$"):
            names.check_cell_name(bad)
    with pytest.raises(ProcessError, match=re.escape(f"for example '{longest}'")):
        names.check_cell_name(longest + "4")


def test_the_nearest_legal_name_keeps_what_it_can():
    assert names.legal_cell_name("lens 0.4\u00b5m") == "lens_0_4_m"
    assert names.legal_cell_name("") == "LENS"
    assert names.legal_cell_name("x" * 40) == "x" * 32
    assert names.legal_cell_name("_") == "_"


def test_the_second_of_a_name_is_refused():
    names.check_distinct_names(["A", "a", "A_2"])
    with pytest.raises(ProcessError, match="two cells are named 'A_2'"):
        names.check_distinct_names(["A", "A_2", "B", "A_2"])
