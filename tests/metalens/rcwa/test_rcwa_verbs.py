"""What holds when nobody says: the documented defaults."""

import inspect

from metalens import rcwa


def test_a_solve_is_to_a_thousandth_at_normal_incidence_unless_said_otherwise():
    told = inspect.signature(rcwa.solve).parameters
    found = {
        name: told[name].default for name in ("tolerance", "angle_rad", "azimuth_rad")
    }
    assert found == {"tolerance": 1e-3, "angle_rad": 0.0, "azimuth_rad": 0.0}
