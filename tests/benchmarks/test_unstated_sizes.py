"""What intervals hold of the unstated, and would with less of it: errors each on its
own side of an end.
"""

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
    """sigma² (1 + share² (whole² - 1)): of 3 times as wide, half is sqrt(3) times,
    which ends at 3.39 sigma.
    """
    one = run([1.9, -3.3, 3.5, -5.8, 6.0], [1.0, 3.0, 3.0, 3.0, 3.0])
    assert referee._holds(one, 0.0) == [True, False, False, False, False]
    assert referee._holds(one, 0.5) == [True, True, False, False, False]
    assert referee._holds(one, 1.0) == [True, True, True, True, False]


def test_clean_and_faulty_benches_have_a_row_for_every_share():
    found = referee._sizes(
        [run([1.0, -2.5], [1.0, 2.0])], [run([3.0, 1.0, 9.0], [2.0, 1.0, 3.0])]
    )
    assert len(found) == 2 * len(referee.SHARES)
    assert [row.error for row in found[:2]] == pytest.approx([1.0, 2 / 3])
    assert [row.error for row in found[-2:]] == pytest.approx([0.5, 1 / 3])
    assert referee._sizes([], [run([1.0], [1.0])]) == []


def test_intervals_that_are_widened_are_counted_by_what_is_there():
    """Three parameters each: two of the first are widened, and one misses; one of the
    second, which holds.
    """
    first = run([1.0, 6.0, 8.0], [1.0, 4.0, 2.0]) | {
        "kind": "glass",
        "outer": {"p0": True, "p1": True, "p2": False},
    }
    first["inside"] = {"p0": True, "p1": False, "p2": False}
    second = run([0.5, 0.7, 3.0], [1.2, 1.0, 5.0]) | {
        "kind": "light",
        "outer": dict.fromkeys(("p0", "p1", "p2"), True),
    }
    refused = {"problems": ["chi-square"], "inside": {}}
    found = {
        row.method: row.error for row in referee._drawn_rows([first, refused, second])
    }
    assert found == pytest.approx(
        {
            "refused": 1 / 3,
            "all parameters covered": 5 / 6,
            "3 intervals widened, covered": 2 / 3,
            "3 intervals widened, covered within the model": 1 / 3,
            "3 intervals widened, error over sigma, rms": (
                ((6 / 4) ** 2 + 4**2 + 0.6**2) / 3
            )
            ** 0.5,
            "2 intervals widened by glass, covered": 1 / 2,
            "2 intervals widened by glass, covered within the model": 0.0,
            "2 intervals widened by glass, error over sigma, rms": (
                ((6 / 4) ** 2 + 4**2) / 2
            )
            ** 0.5,
            "1 intervals widened by light, covered": 1.0,
            "1 intervals widened by light, covered within the model": 1.0,
            "1 intervals widened by light, error over sigma, rms": 0.6,
        }
    )
    assert referee._drawn_rows([refused]) == []
