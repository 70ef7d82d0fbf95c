"""The designer's page of ``metalens evaluate optics``: what is asked for, what stands
in tables, what is refused.
"""

import math

import numpy as np
import pytest

from codesign.evaluate import FieldSetting, field_page
from metalens.aberrations import OverField, over_field
from metalens.core.errors import ConfigError
from tests.metalens.aberrations.hyperbolic import made


def typed(**changes):
    """Two angles, two frequencies, no two values alike; the second angle has no chief
    ray.
    """
    given = {
        "angles_deg": np.array([-4.0, 9.0]), "depth_um": 21e3, "sensor_distance_um": 2000.0,
        "chief_um": np.array([[-140.256, 0.1], [math.nan] * 2]), "distortion": np.array([-0.01234, math.nan]),
        "close_um": np.array([[-12.34, -5.67], [math.nan] * 2]),
        "close_error_um": np.array([[0.4, 0.3], [math.nan] * 2]),
        "vignetting": np.array([0.0, 0.0625]),
        "illumination": np.array([0.987, math.nan]), "frequencies_per_mm": np.array([37.0, 74.0]),
        "mtf": np.array([[[0.81, 0.62], [0.83, 0.64]], [[0.41, 0.22], [0.53, 0.34]]]),
        "held": np.array([0.99, 0.98]), "left_out": ("the chief ray of (9, 0) degrees is lost",),
    }  # fmt: skip
    return OverField(**(given | changes))


def test_every_number_stands_under_its_name_with_its_unit():
    fields, curves = field_page.field_tables({"mine": typed()})
    rows = [dict(zip(fields.head, row, strict=False)) for row in fields.rows]
    assert list(fields.rows[0]) == [
        "mine",
        "-4",
        "-140.26",
        "-1.23",
        "-12.3",
        "-5.7",
        "0.00",
        "0.987",
    ]
    assert list(fields.rows[1]) == ["", "9", "–", "–", "–", "–", "6.25", "–"]
    assert rows[0]["vignetting / %"] == "0.00"
    assert fields.head[3:6] == ("distortion / %", "close rays T / µm", "S / µm")
    assert "21 mm" in fields.caption
    assert "mine: the chief ray of (9, 0) degrees is lost." in fields.caption
    assert curves.head == (
        "lens",
        "angle / °",
        "T at 37 / mm",
        "S at 37 / mm",
        "T at 74 / mm",
        "S at 74 / mm",
    )
    assert list(curves.rows[1]) == ["", "9", "0.410", "0.530", "0.220", "0.340"]


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
    [({"angles_deg": ()}, "angles_deg"), ({"angles_deg": (85.0,)}, "between -85 and 85"),
     ({"frequencies_per_mm": (0.0,)}, "frequencies_per_mm"), ({"frequencies_per_mm": ()}, "one or more"),
     ({"depth_mm": 0.0}, "depth_mm"), ({"depth_mm": math.nan}, "depth_mm")],
)  # fmt: skip
def test_impossible_settings_are_refused_by_name(changes, named):
    with pytest.raises(ConfigError, match=named):
        FieldSetting(**changes)
