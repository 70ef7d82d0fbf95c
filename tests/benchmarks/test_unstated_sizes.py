"""What intervals would hold with less of the unstated reckoned with: four errors, each on its own side of an end."""

import pytest

from benchmarks import characterize_referee as referee


def run(z, whole):
    names = [f"p{k}" for k in range(len(z))]
    return {
        "inside": dict.fromkeys(names, True),
        "z": dict(zip(names, z, strict=True)),
        "wider": dict(zip(names, whole, strict=True)),
        "problems": [],
    }


def test_a_share_of_the_unstated_adds_in_squares():
    """sigma² (1 + share² (whole² - 1)): of 3 times as wide, half is sqrt(3) times, which ends at 3.39 sigma."""
    one = run([1.9, -3.3, 3.5, -5.8, 6.0], [1.0, 3.0, 3.0, 3.0, 3.0])
    assert referee._holds(one, 0.0) == [True, False, False, False, False]
    assert referee._holds(one, 0.5) == [True, True, False, False, False]
    assert referee._holds(one, 1.0) == [True, True, True, True, False]


def test_clean_and_faulty_benches_have_a_row_for_every_share():
    found = referee._sizes([run([1.0, -2.5], [1.0, 2.0])], [run([3.0, 1.0, 9.0], [2.0, 1.0, 3.0])])
    assert len(found) == 2 * len(referee.SHARES)
    assert [row.error for row in found[:2]] == pytest.approx([1.0, 2 / 3])
    assert [row.error for row in found[-2:]] == pytest.approx([0.5, 1 / 3])
    assert referee._sizes([], [run([1.0], [1.0])]) == []
