"""A plate of glass: Fermat's least path over all places where the ray could enter, and
the images that it makes.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.model.glass import INDEX, extra_path
from characterize.model.parameters import parameter_vector
from metalens.core.errors import FitError

DEPTH, TANGENTS = 411.0, (0.031, -0.017)


def least_path(x, y, values):
    """Source to (x, y, 0): in air to the plate, straight through it, in air again; its
    planes are tilted alike.
    """
    source = np.array([-DEPTH * TANGENTS[0], -DEPTH * TANGENTS[1], -DEPTH])
    lean = [np.tan(np.radians(values.get(f"glass_tilt_{a}_deg", 0.0))) for a in "xy"]
    normal = np.array([*lean, 1.0]) / np.linalg.norm([*lean, 1.0])
    across = np.linalg.svd(normal[None])[2][1:]
    planes = (
        -150.0,
        -150.0 + values["glass_um"],
    )  # along the normal, somewhere between source and lens

    def path(at):
        first, second = (
            p * normal + c @ across
            for p, c in zip(planes, (at[:2], at[2:]), strict=True)
        )
        legs = first - source, second - first, np.array([x, y, 0.0]) - second
        air, glass, more = (float(np.linalg.norm(leg)) for leg in legs)
        return air + INDEX * glass + more

    return optimize.minimize(
        path, np.zeros(4), method="BFGS", options={"gtol": 1e-10}
    ).fun - np.linalg.norm(np.array([x, y, 0.0]) - source)


@pytest.mark.parametrize(
    "values",
    [
        {"glass_um": 97.0},
        {"glass_um": 97.0, "glass_tilt_x_deg": 9.0, "glass_tilt_y_deg": -4.0},
    ],
)
def test_the_path_through_glass_is_the_least(values):
    x, y = 37.3, -21.9
    found = extra_path(
        np.array(x),
        np.array(y),
        tangents=TANGENTS,
        depth_um=DEPTH,
        values=parameter_vector(values),
    )
    want = least_path(x, y, values) - least_path(0.0, 0.0, values)
    assert abs(want) > 0.1
    assert found == pytest.approx(
        want, abs=1e-6
    )  # of a search that ends at a slope of 1e-10


def test_frames_through_glass_are_those_of_every_pillar():
    from characterize.model.forward import ForwardModel, FrameSetting

    model = ForwardModel(
        b.lens(),
        FrameSetting(np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16),
        b.RESPONSE,
    )
    glass = {"glass_um": 60.0, "glass_tilt_x_deg": 6.0}
    x = parameter_vector(
        b.VALUES | glass | {"background_e": 0.0, "background_x_e": 0.0}
    )
    found, want = model.images(x)[0], b.light(**glass)
    scale = (found * want).sum() / (found**2).sum()
    assert np.abs(scale * found - want).max() < 1e-3 * want.max()  # as without glass
    plain = b.light()
    assert np.abs(plain / plain.max() - want / want.max()).max() > 0.05


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
def test_a_plate_that_has_no_room_is_refused(tilt_deg):
    """Along the normal of a tilted plate the source is nearer: 40 cos 30 degrees less
    than 35 um.
    """
    values = parameter_vector({"glass_um": 35.0, "glass_tilt_x_deg": tilt_deg})
    at = np.array([2.0]), np.array([-3.0])
    if tilt_deg:
        with pytest.raises(
            FitError,
            match=r"35 um of glass between lens and source, which leave 3\d\.\d+ um",
        ):
            extra_path(*at, tangents=(0.0, 0.0), depth_um=40.0, values=values)
    else:
        assert np.isfinite(
            extra_path(*at, tangents=(0.0, 0.0), depth_um=40.0, values=values)
        ).all()
