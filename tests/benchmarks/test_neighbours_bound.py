"""The share by which zones that get shorter change less is what the lenses solved whole
show at most.
"""

import json
import re
from pathlib import Path

import pytest

from metalens.lens import CURVED

RESULT = Path(__file__).parents[2] / "benchmarks" / "results" / "neighbours.json"


def test_the_share_is_the_largest_that_was_found():
    """Error of the predicted power in the focus over what unlike neighbours take of it;
    of four cuts.
    """
    shares = []
    for row in json.loads(RESULT.read_text(encoding="utf-8"))["rows"]:
        without = re.search(r"without: ([0-9.]+)", row["against"])
        if without and "solved whole" in row["against"]:
            shares.append(row["error"] / float(without[1]))
    assert len(shares) == 4
    assert max(shares) == pytest.approx(CURVED, rel=0.05)  # one digit is known of it
    assert sorted(shares)[-2] < CURVED
