"""Work that is interrupted goes on where it stopped, however often, and ends in the
same numbers.
"""

import math

import pytest

from codesign.budget import Journal
from metalens.ground.errors import StoreError


def parts(path, title, *, until=99):
    """Three parts of work that dies at number ``until``; the values, and which were
    computed.
    """
    computed, journal = [], Journal(path, title)

    def work(k):
        if k == until:
            raise KeyboardInterrupt
        computed.append(k)
        return [k / 3, [math.nan, 1e-300], f"part {k}"]

    found = [journal.part(f"part {k}", lambda k=k: work(k)) for k in range(3)]
    journal.finish()
    return found, computed


def test_cut_twice_in_the_middle_of_a_line_it_goes_on(tmp_path):
    path = tmp_path / "out.resume"
    whole, _ = parts(None, "0.1 a")
    for until in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            parts(path, "0.1 a", until=until)
        with open(path, "ab") as file:
            file.write(b'["part 2", [0.1, [1')  # what a kill leaves of the next line
    found, computed = parts(path, "0.1 a")
    assert computed == [2]
    assert repr(found) == repr(whole)
    assert not path.exists()


def test_the_journal_of_other_work_and_damaged_lines_are_not_read(tmp_path):
    path = tmp_path / "out.resume"
    with pytest.raises(KeyboardInterrupt):
        parts(path, "0.1 a", until=2)
    path.write_text(path.read_text().replace('["part 0"', "[[[["))
    with pytest.raises(KeyboardInterrupt):
        parts(path, "0.1 a", until=0)
    assert parts(path, "0.2 b")[1] == [0, 1, 2]


def test_a_file_of_the_user_is_no_journal_and_stays(tmp_path):
    path = tmp_path / "out.resume"
    path.write_text("my notes\n")
    with pytest.raises(StoreError, match="no journal of metalens"):
        Journal(path, "0.1 a")
    assert path.read_text() == "my notes\n"


def test_an_input_that_is_replaced_ends_the_work_before_its_part_is_kept(tmp_path):
    table, path = tmp_path / "film.csv", tmp_path / "out.resume"
    table.write_text("0.8,3.60")
    journal = Journal(path, "0.1 a", inputs=[table])
    assert journal.part("one", lambda: 3) == 3
    with pytest.raises(StoreError, match=r"film\.csv was changed or replaced"):
        journal.part("two", lambda: table.write_text("0.8,3.612"))
    assert len(path.read_text().splitlines()) == 2  # its title and the first
