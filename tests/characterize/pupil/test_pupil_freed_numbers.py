"""Optics that are known roughly: what the fit is told, and what comes back, number by
number.
"""

import dataclasses
import math

import numpy as np
import pytest

from characterize.pupil import free
from characterize.pupil.record import PupilModel, PupilSpec

SPEC = PupilSpec(
    0.32, 0.5, 0.4, window=12, phase_order=7, amplitude_order=3, drift_order=1, model_error=0.0,
    free=("numerical_aperture", "step_um", "pixel_um"),
)  # fmt: skip
Z = np.array([-6.0, -1.0, 2.0, 7.0])


def test_factors_are_exponentials_and_the_aperture_stays_below_the_index():
    images = free._Images(SPEC, Z)
    made, position = images.optics(np.log([1.1, 0.7, 1.3]))
    assert made.numerical_aperture == pytest.approx(0.352)
    assert made.pixel_um == pytest.approx(0.52)
    assert position == pytest.approx(0.7 * Z)
    steep = dataclasses.replace(
        SPEC, numerical_aperture=0.9, free=("numerical_aperture", "index")
    )
    made, position = free._Images(steep, Z).optics(np.log([1.2, 0.9]))
    assert (made.index, made.numerical_aperture) == pytest.approx(
        (1.0, 0.98)
    )  # no less than air, 0.98 of it
    assert position == pytest.approx(Z)
    oil = dataclasses.replace(
        SPEC, numerical_aperture=1.35, index=1.5, free=("numerical_aperture",)
    )
    assert free._Images(oil, Z).optics(np.log([1.3]))[
        0
    ].numerical_aperture == pytest.approx(0.98 * 1.5)
    assert free._Images(oil, Z).optics(np.log([1.05]))[
        0
    ].numerical_aperture == pytest.approx(1.35 * 1.05)
    assert images.orders == {"phase_order": 6, "amplitude_order": 2}


def test_all_apertures_and_steps_share_the_nodes_of_the_widest():
    widest = dataclasses.replace(SPEC, numerical_aperture=1.2 * 0.32)
    want = PupilModel(widest, 1.1 * Z, phase_order=6, amplitude_order=2).nodes
    assert free._Images(SPEC, Z).nodes == want
    assert free._Images(SPEC, Z)._at(np.array([-0.2, 0.1, 0.0])).nodes == want
    high = dataclasses.replace(
        SPEC, numerical_aperture=0.9, free=("numerical_aperture",)
    )
    limit = dataclasses.replace(high, numerical_aperture=0.97)
    assert (
        free._Images(high, Z).nodes
        == PupilModel(limit, 1.1 * Z, phase_order=6, amplitude_order=2).nodes
    )
    oil = dataclasses.replace(high, numerical_aperture=1.35, index=1.5)
    limit = dataclasses.replace(oil, numerical_aperture=0.97 * 1.5)
    assert (
        free._Images(oil, Z).nodes
        == PupilModel(limit, 1.1 * Z, phase_order=6, amplitude_order=2).nodes
    )


def test_slopes_by_the_factors_are_differences_of_images():
    """One by one, the rest as the model has them; compared with steps ten times as
    fine.
    """
    images = free._Images(SPEC, Z)
    layout = images.model.layout()
    x = np.concatenate(
        [np.random.default_rng(2).normal(0, 0.1, layout.size), [0.02, -0.03, 0.01]]
    )
    x[layout.size - 2 * layout.frames - 1] = 0.3
    image, slopes = images(x, True)
    plain, none = images(x, False)
    assert none is None
    assert image == pytest.approx(plain)
    assert len(slopes) == len(x)
    own = images._at(x[-3:]).images(x[:-3], True)[1]
    assert slopes[:-3] == pytest.approx(own)
    for k in range(3):
        step = 1e-4 * np.eye(3)[k]
        up, down = (
            images._at(x[-3:] + s * step).images(x[:-3], False)[0] for s in (1, -1)
        )
        want = (up - down) / 2e-4
        assert (
            np.abs(slopes[-3 + k] - want).max() < 1e-4 * np.abs(want).max()
        )  # third derivatives times 1e-6


def test_what_was_freed_is_said_beside_what_was_stated():
    told = free.freed_text(
        SPEC, (("numerical_aperture", 0.336, 0.004), ("step_um", 2.34, 0.05))
    )
    assert told == [
        "numerical_aperture = 0.336 +- 0.004 was fitted, stated 0.32",
        "step_um = 2.34 +- 0.05 was fitted",
    ]
    assert math.isnan(SPEC.step_um)


@pytest.mark.parametrize(("aperture", "kind"), [(0.58, "vector"), (0.49, "scalar")])
def test_the_kind_of_the_model_is_the_same_at_every_aperture_on_the_way(aperture, kind):
    """``auto`` turns vectorial at 0.6: 0.58 may lead there (0.70 at the widest), 0.49
    does not (0.588).
    """
    near = dataclasses.replace(
        SPEC, numerical_aperture=aperture, free=("numerical_aperture",)
    )
    images = free._Images(near, Z)
    assert {
        images.optics(np.log([factor]))[0].model for factor in (0.9, 1.0, 1.02, 1.2)
    } == {kind}
    stated = dataclasses.replace(near, model="scalar")
    assert free._Images(stated, Z).optics(np.zeros(1))[0].model == "scalar"
