"""A made lens seen at a field angle: against the sum over every pillar."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from characterize.model import as_built
from characterize.model.parameters import PLACE, parameter_vector
from codesign.optics import as_built_lens
from codesign.optics.stack import PixelPsfStack
from metalens import psf
from metalens.fabrication import proxy_sensitivity
from tests.codesign import made_lens as m

X = parameter_vector(m.TRUE)


@pytest.mark.parametrize("angle_deg", [9.0, -14.0])
def test_oblique_psfs_agree_with_the_sum_over_every_pillar(angle_deg):
    """Low-passed to the run's samples like the run's own; rim cells of the pupil and
    light of other orders leave 3 % here.
    """
    settings = dataclasses.replace(m.OPTICS, angle_deg=angle_deg)
    lens, known = m.small(), m.at_rest(X)
    t = as_built.as_built_transmission(lens, proxy_sensitivity(lens), known)
    samples, window = 8 * 15, 45.0
    found = psf.psf_stack(
        np.angle(t), np.abs(t), pitch_um=0.4, wavelength_um=0.85,
        depths_um=settings.depths_um.numpy(), angle_rad=math.radians(angle_deg),
        sensor_distance_um=300.0 + float(known[PLACE["distance_um"]]),
        window_um=window, samples=samples, tolerance=1e-4,
    )  # fmt: skip
    edge = window / (2 * settings.sample_um)
    order = np.arange(1, int(edge + 0.5) + 1)
    kept = np.clip(edge - order + 0.5, 0, 1)
    kept = kept * np.sinc(order / window * settings.sample_um)
    place = (np.arange(11) - 5) * settings.sample_um
    fine = (np.arange(samples) - (samples - 1) / 2) * window / samples
    waves = np.cos(2 * np.pi * order / window * (place[:, None] - fine)[..., None])
    rows = settings.sample_um / window * (1 + 2 * (waves * kept).sum(-1))
    light = np.asarray(found.intensity).reshape(3, samples, samples)
    want = PixelPsfStack(torch.as_tensor(rows @ light @ rows.T), settings.depths_um)
    got = as_built_lens.MadeLens(lens, settings).stack(X)
    assert as_built_lens.psf_error(got, want) < 0.03
    on_axis = as_built_lens.MadeLens(lens, m.OPTICS).stack(X)
    assert as_built_lens.psf_error(on_axis, want) > 0.1
