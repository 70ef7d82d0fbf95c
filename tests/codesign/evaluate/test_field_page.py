"""The designer's page of ``metalens evaluate optics``: what is asked for, what stands
in tables, what is refused.
"""

import math

import pytest

from codesign.evaluate import FieldSetting
from metalens.aberrations import over_field
from metalens.core.errors import ConfigError
from tests.metalens.aberrations.hyperbolic import made


def test_what_is_left_out_is_of_the_first_lens_and_the_other_angles():
    first, second = made("plain"), made("off-centre")
    found = FieldSetting().of(second, first, (0.0, 3.0))
    assert found.angles_deg.tolist() == [0.0, 3.0]
    assert found.depth_um == 1900.0
    assert (
        found.frequencies_per_mm.tolist()
        == over_field(first, (0.0,)).frequencies_per_mm.tolist()
    )
    asked = FieldSetting((-2.0,), (55.0,), 1.3).of(second, first, (0.0, 3.0))
    want = over_field(second, (-2.0,), depth_um=1300.0, frequencies=(55.0,))
    assert asked.depth_um == 1300.0
    assert asked.mtf.tolist() == want.mtf.tolist()


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"angles_deg": ()}, "angles_deg"), ({"angles_deg": (85.0,)}, "need -84.9 to 84.9"),
     ({"frequencies_per_mm": (0.0,)}, "frequencies_per_mm"), ({"frequencies_per_mm": ()}, "one or more"),
     ({"depth_mm": 0.0}, "depth_mm"), ({"depth_mm": math.nan}, "depth_mm")],
)  # fmt: skip
def test_impossible_settings_are_refused_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        FieldSetting(**changes)
