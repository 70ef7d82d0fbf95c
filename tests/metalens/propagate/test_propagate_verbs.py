"""What holds when nobody says: the documented defaults."""

import inspect

from metalens import propagate


def test_the_windowed_engine_is_to_a_ten_thousandth_and_the_textbook_pads_twice():
    assert inspect.signature(propagate.windowed).parameters["tolerance"].default == 1e-4
    told = inspect.signature(propagate.angular_spectrum).parameters
    assert {n: told[n].default for n in ("pad", "band_limited", "single")} == {
        "pad": 2,
        "band_limited": False,
        "single": False,
    }
