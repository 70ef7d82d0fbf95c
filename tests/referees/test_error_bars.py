"""The information that a fit claims, against differences of the referee's own frames in
electrons that it counted.
"""

import dataclasses

import numpy as np
import pytest

from characterize.captures import to_electrons
from characterize.inference import leastsquares
from characterize.inference.leastsquares import SolverSettings
from characterize.inference.multistart import SearchTask
from characterize.inference.prepare import data_of
from characterize.model import (
    PARAMETERS,
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


@pytest.mark.slow
def test_scores_of_the_referee_s_noise_scatter_as_the_fit_believes():
    """Photons, read noise, 12 bits, dark of 8 and flat of 24 frames, cleaned as
    captures are: chi-square of 23 degrees.

    With S the slopes over the noise, n the noise, V the scatter of S n with the errors
    of dark and flat in common,
    nᵀSᵀ V⁻¹ S n; over 60 sessions its mean scatters by sqrt(2 x 23 / 60) = 0.9. The
    gain errs by 2.5 % in each.
    """
    lens, session = hidden.lens(), hidden.session(21)
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
    start = parameter_vector(session.values)
    model = ForwardModel(lens, setting, log_response_slopes(lens))
    bare = model.images(
        parameter_vector(session.values | dict.fromkeys(hidden.PLANE, 0.0))
    )[0]
    light = seen.electrons - bench._background(session)
    start[PLACE["log_gain"]] = np.log((light * bare).sum() / (bare**2).sum())
    names = [p.name for p in PARAMETERS if p.free]
    image, by = model.images(start, names)
    assert np.abs(image - seen.electrons).max() < 2e-3 * image.max()
    rng, found = np.random.default_rng(7), []
    for _ in range(60):
        response = 1 + 0.007 * rng.standard_normal(image.shape[1:])
        fixed = 97 + 2.0 * rng.standard_normal(image.shape[1:])
        parts = (
            seen.electrons * response,
            np.zeros((8, side, side)),
            np.full((24, side, side), 6800.0) * response,
        )
        frames, dark, flat = (bench._read(part, session, rng, fixed) for part in parts)
        shots = to_electrons(
            dataclasses.replace(seen.capture, frames=frames, dark=dark, flat=flat)
        )
        data = data_of(shots, (slice(None), slice(None)))
        counted = shots.gain.gain_e / session.gain_e
        root = data.usable / np.sqrt(data.variance(counted * image))
        slope = counted * by * root
        score = np.tensordot(
            slope, (data.electrons - counted * seen.electrons) * root, 3
        )
        shared = data.shared(counted * image) * root
        floor, lit = ((slope * one).sum(1).reshape(len(names), -1) for one in shared)
        alone = (slope * shared[0]).reshape(len(names), -1)
        scatter = (
            np.tensordot(slope, slope, ([1, 2, 3],) * 2)
            + floor @ floor.T
            + lit @ lit.T
            - alone @ alone.T
        )
        found.append(float(score @ np.linalg.solve(scatter, score)))
    assert np.mean(found) == pytest.approx(len(names), abs=3.5)  # four of its sigma
    assert (
        0.7 < np.std(found) / np.sqrt(2 * len(names)) < 1.35
    )  # four of that of a standard deviation, 9 %
    assert (
        max(found) < 59
    )  # one in 2000 of such sessions beyond 51, one in 20000 beyond 59


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
    counted = (
        frames.gain.gain_e / session.gain_e
    )  # electrons of the fit for one of the referee
    start[PLACE["log_gain"]] = np.log(counted * (light * bare).sum() / (bare**2).sum())
    assert frames.gain.gain_e == pytest.approx(
        session.gain_e, rel=0.1
    )  # four of its sigma
    task = SearchTask(
        model, data_of(frames, (slice(None), slice(None))), start, {}, None
    )
    truth = start[[PLACE[name] for name in task.names]]
    found = leastsquares.fit_levenberg_marquardt(
        task.posed().model,
        task.data,
        truth,
        prior=task.prior,
        settings=SolverSettings(iterations=0),
    )
    want = seen_by_differences(
        session, light.max() / bench.irradiance(lens, session).max()
    )
    for name, information in want.items():
        i = task.names.index(name)
        assert found.information[i, i] == pytest.approx(
            information * counted, rel=0.05
        ), name
    claimed = np.sqrt(np.diag(found.covariance))
    assert (
        claimed >= np.diag(found.information) ** -0.5
    ).all()  # others are unknown too
