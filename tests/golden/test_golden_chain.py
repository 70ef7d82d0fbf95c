"""Outputs of the whole chain on one small lens without symmetry: each beside a plain sum
and beside the value that is stored with its error bar.
"""

import json

import pytest

from tests.golden import outputs

STORED = json.loads(outputs.STORED.read_text(encoding="utf-8"))


@pytest.mark.parametrize("group", outputs.GROUPS)
def test_outputs_agree_with_plain_sums_and_with_stored_values(small_chain, group):
    found = outputs.outputs(group, small_chain)
    assert {one.name for one in found} == set(STORED[group])
    for one in found:
        assert abs(one.value - one.judge) <= one.bar, one
        value, bar = STORED[group][one.name]
        assert abs(one.value - value) <= bar, (one, value, bar)
