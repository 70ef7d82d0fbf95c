"""The information that a fit claims, against differences of the referee's own frames in
electrons that it counted.
"""

import dataclasses

import numpy as np
import pytest

from characterize.captures import to_electrons
from characterize.inference.leastsquares import SolverSettings
from characterize.inference.multistart import SearchTask
from characterize.inference.prepare import data_of
from characterize.model import (
    PLACE,
    ForwardModel,
    FrameSetting,
    log_response_slopes,
    parameter_vector,
)
from tests.referees import hidden_lens as hidden
from tests.referees import pillar_bench as bench

STEPS = {
    "bias_nm": 0.3,
    "height_nm": 0.5,
    "coma_x_rad": 0.02,
    "distance_um": 0.3,
    "crosstalk_px": 0.02,
}


def seen_by_differences(session, scale):
    """{name: sum over all pixels of (dI / dx)² over the variance of a pixel}, from the
    referee alone.
    """
    lens = hidden.lens()
    light = bench.irradiance(lens, session) * scale
    variance = (
        light
        + bench._background(session)
        + session.read_noise_e**2
        + session.gain_e**2 / 12
    )
    found = {}
    for name, step in STEPS.items():
        ends = [
            bench.irradiance(
                lens,
                dataclasses.replace(
                    session, values=session.values | {name: session.of(name) + s}
                ),
            )
            for s in (step, -step)
        ]
        slope = scale * (ends[0] - ends[1]) / (2 * step)
        found[name] = float((slope**2 / variance).sum())
    return found


def test_the_fit_knows_how_much_its_frames_tell():
    """At the truth. The information goes as the gain, which 24 flats give to 2.5 %;
    low-rank slopes leave 2 %.
    """
    lens, session = hidden.lens(), hidden.session(6)
    seen = bench.shoot(lens, session)
    n, side = len(session.depths_um), session.pixels
    setting = FrameSetting(
        np.array(session.depths_um),
        np.zeros((n, 2)),
        np.ones(n),
        session.pixel_um,
        side,
        side,
    )
    model = ForwardModel(lens, setting, log_response_slopes(lens))
    start = parameter_vector(session.values)
    light = seen.electrons - bench._background(session)
    bare = model.images(
        parameter_vector(session.values | dict.fromkeys(hidden.PLANE, 0.0))
    )[0]
    frames = to_electrons(seen.capture)
    # electrons of the fit for one of the referee
    counted = frames.gain.gain_e / session.gain_e
    start[PLACE["log_gain"]] = np.log(counted * (light * bare).sum() / (bare**2).sum())
    # four of its sigma
    assert frames.gain.gain_e == pytest.approx(session.gain_e, rel=0.1)
    task = SearchTask(model, data_of(frames, (slice(None), slice(None))), start, {})
    truth = start[[PLACE[name] for name in task.names]]
    found = task.posed().fit(truth, SolverSettings(iterations=0))
    want = seen_by_differences(
        session, light.max() / bench.irradiance(lens, session).max()
    )
    for name, information in want.items():
        i = task.names.index(name)
        assert found.information[i, i] == pytest.approx(
            information * counted, rel=0.05
        ), name
    claimed = np.sqrt(np.diag(found.covariance))
    # others are unknown too
    assert (claimed >= np.diag(found.information) ** -0.5).all()
