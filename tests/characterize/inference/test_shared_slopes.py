"""Quick against thorough: Jacobians put together from those of other places, beside
computing each of them.
"""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import leastsquares, posterior, search, walk
from characterize.inference.arrange import FrameArrangement
from characterize.inference.leastsquares import SolverSettings
from characterize.model import NAMES, PLACE, KnownValue, parameter_vector
from tests.referees.one_profile import profile

DEPTHS = (560.0, 600.0, 640.0)
FREE = (
    "bias_nm",
    "height_nm",
    "stage_zero_um",
    "stage_scale",
    "spherical_rad",
    "log_gain",
    "background_e",
)


@pytest.fixture(scope="module")
def about():
    """A lens near its focus, where bias, height and spherical are bent; its frames, and
    its fit.
    """
    values = {
        "bias_nm": 13.0,
        "height_nm": -7.0,
        "stage_zero_um": 4.0,
        "spherical_rad": 0.11,
    }
    data, model = b.near_focus(DEPTHS, **values)
    held = {name: KnownValue(name, 0.0) for name in NAMES if name not in FREE}
    laid = FrameArrangement(0, 0, (0, 0), 1, np.arange(3), False, True, 0, False, ())
    task = search.SearchTask(model, data, parameter_vector(), held, laid)
    begin = np.zeros(len(task.names))
    light = model.images(parameter_vector())[0]
    begin[task.names.index("log_gain")] = math.log(
        (light * data.electrons).sum() / (light**2).sum()
    )
    return task, search.refine_fit(task, begin)


def valley(about):
    task, mode = about
    return posterior.LocalMode(
        task.problem(),
        task.data,
        mode.value,
        task.prior,
        known=(mode.image, mode.slopes),
    )


@pytest.mark.parametrize("name", ["bias_nm", "height_nm", "spherical_rad"])
def test_ends_with_slopes_of_other_ends_are_those_with_slopes_of_their_own(
    about, name, monkeypatch
):
    """Slopes are taken over where the trapezium rule misses 0.4 sigma or less: 0.4² / 2
    of the misfit, 0.02 of its
    root at 1.96; a search ends within 0.08 of the root and goes on by proportion, which
    leaves 0.02 to either."""
    task, _ = about
    quick, i = valley(about), task.names.index(name)
    for other in ("height_nm", "bias_nm"):  # ends that it may take slopes over from
        profile(quick, task.names.index(other))
    shared, _ = profile(quick, i)
    monkeypatch.setattr(posterior, "_HOLDS", 0.0)
    alone, _ = profile(valley(about), i)
    assert alone.high - alone.low > 3 * float(quick.sigma[i])
    assert (shared.low, shared.high) == pytest.approx(
        (alone.low, alone.high), abs=0.04 * float(quick.sigma[i])
    )


def test_slopes_taken_over_are_near_those_computed(about):
    """Half way to an end whose slopes are known: what is left is of second order."""
    one = valley(about)
    i = about[0].names.index("bias_nm")
    end = one.mode + 3 * one.along(i)
    images = about[0].problem()

    def exact(x):
        return one._columns(*images(x, True)) @ np.linalg.cholesky(one.covariance)

    first = exact(end) - exact(one.mode)
    assert np.linalg.norm(first, 2) > 0.2  # of sigma by sigma: worth a Jacobian
    one.met = ((end - one.mode, one._columns(*images(end, True)) - one.slopes),)
    half = one.mode + 1.5 * one.along(i)
    left = one.slopes_at(half) @ np.linalg.cholesky(one.covariance) - exact(half)
    assert len(one.met) == 1  # taken over, not computed
    assert np.linalg.norm(left, 2) < 0.2 * np.linalg.norm(first, 2)


def test_stops_between_two_of_a_walk_are_as_low_as_with_slopes_of_their_own(about):
    """A stop ends where a step promises less than 0.3 sigma, 0.09 of the misfit; so
    does the one beside it.
    """
    task, mode = about
    i, part = task.names.index("bias_nm"), (task.problem(), task.data)
    step = float(np.sqrt(mode.covariance[i, i]))
    stops = walk._side(
        task,
        part,
        mode,
        i,
        float(mode.value[i] + 4 * step),
        step=step,
        settings=walk._NEAR,
    )
    assert [s.value[i] for s in stops] == pytest.approx(
        mode.value[i] + step * np.arange(1, 5)
    )
    for one in stops:
        held = walk._holding(task.prior, i, float(one.value[i]))
        best = leastsquares.fit_levenberg_marquardt(
            *part, one.value, prior=held, settings=SolverSettings()
        )
        least = walk._measured(task, task.data, best.value, best.image)
        assert one.merit == pytest.approx(least, abs=0.1)


@pytest.mark.parametrize("name", ["stage_scale", "stage_zero_um", "distance_um"])
def test_derivatives_that_are_put_together_are_central_differences(about, name):
    """Stage scale by the zero, the window's own moves with a tolerance by their size:
    the 8e-3 of all derivatives.
    """
    model = about[0].model
    x = parameter_vector(
        {
            "stage_zero_um": 4.0,
            "spherical_rad": 0.11,
            "log_gain": 9.0,
            "pinhole_um": 1.7,
        }
    )
    step = {
        "stage_scale": 1e-3,
        "stage_zero_um": 0.3,
        "distance_um": 0.1,
        "wavelength_nm": 0.1,
    }[name]
    up, down = x.copy(), x.copy()
    up[PLACE[name]] += step
    down[PLACE[name]] -= step
    want = (model.images(up)[0] - model.images(down)[0]) / (2 * step)
    found = model.images(x, [name])[1][0]
    assert np.linalg.norm(found - want) < 0.01 * np.linalg.norm(want)
