"""Planes that stand off their stated positions, in stacks by a plain vectorial sum that
shares no code with the fit.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from characterize.captures import capture
from characterize.pupil.fit import fit_pupil
from characterize.pupil.model import PupilModel, PupilSpec
from metalens.core.errors import FitError

SPEC = PupilSpec(
    0.9, 0.52, 0.13, window=34, phase_order=5, amplitude_order=2, drift_order=1
)
Z = 0.3 * (np.arange(13) - 6.0)
# 36 nm rms of 300
OFF = np.array([-50, -40, -45, -10, -70, -5, -30, 30, 30, 40, 25, 0, 25]) * 1e-3
TRUE = {
    "oblique astigmatism": 0.31,
    "astigmatism": -0.22,
    "coma y": 0.27,
    "coma x": -0.14,
    "trefoil": 0.19,
}


def beads():
    """Electrons of an isotropic emitter at true places: three dipoles, both
    polarisations, 24 radii by 64 turns.

    Of a ray along (theta, phi) a dipole d gives (d theta^) along rho^ and (d phi^)
    along phi^, over sqrt(cos theta).
    """
    x, weight = np.polynomial.legendre.leggauss(24)
    rho, phi = (
        one.ravel() for one in np.meshgrid((x + 1) / 2, 2 * np.pi * np.arange(64) / 64)
    )
    u, v, sine = rho * np.cos(phi), rho * np.sin(phi), 0.9 * rho
    cosine, c, s = np.sqrt(1 - sine**2), np.cos(phi), np.sin(phi)
    r2, root = math.sqrt(6), math.sqrt(8)
    phase = TRUE["oblique astigmatism"] * r2 * 2 * u * v + TRUE["astigmatism"] * r2 * (
        u * u - v * v
    )
    phase += root * (3 * rho**2 - 2) * (TRUE["coma y"] * v + TRUE["coma x"] * u)
    phase += TRUE["trefoil"] * root * (u**3 - 3 * u * v * v)
    light = np.exp(1j * phase) / np.sqrt(cosine) * np.tile((x + 1) / 2 * weight, 64)
    k = 2 * np.pi / 0.52
    place = ((np.arange(34) - 17)[:, None] + np.array([-1, 0, 1]) / 3).ravel() * 0.13
    down = np.exp(1j * k * np.outer(place, 0.9 * v))
    across = np.exp(1j * k * np.outer(0.9 * u, place))
    stack = np.zeros((13, 102, 102))
    for image, z in zip(stack, Z + OFF, strict=True):
        for radial, around in ((cosine * c, -s), (cosine * s, c), (-sine, 0.0)):
            for field in (radial * c - around * s, radial * s + around * c):
                image += (
                    abs((down * (light * field * np.exp(1j * k * cosine * z))) @ across)
                    ** 2
                )
    seen = stack.reshape(13, 34, 3, 34, 3).sum((2, 4))
    return seen * (5000 / seen.max()) + 25


def shots():
    counts = np.random.default_rng(4).poisson(beads())
    about = {"gain_e": 1.0, "offset": 0, "read_noise_e": 0.0}
    alone = np.full(13, np.nan)
    return capture.Capture(
        counts.astype(np.uint16),
        Z - Z[0],
        np.zeros((13, 2)),
        alone,
        ("",) * 13,
        16,
        about=about,
    )


def test_planes_off_their_places_move_no_pupil_beyond_its_interval():
    """Taken for exact, they pass for apodisation of 20 sigma. Zero and mean step of the
    stage, which are as good as
    defocus and spherical, are known by priors alone."""
    seen = shots()
    found, exact = (
        fit_pupil(seen, replace(SPEC, stage_sigma_um=s), judge=False)
        for s in (math.nan, 0.0)
    )
    missed = []
    for fit in (found, exact):
        rows = {
            name: (v, s)
            for name, v, s in zip(fit.names, fit.value, fit.sigma, strict=True)
        }
        rows = {n: r for n, r in rows.items() if n.startswith(("phase", "log-amp"))}
        want = {
            name: TRUE.get(name.removeprefix("phase ").removesuffix(" / rad"), 0.0)
            for name in rows
        }
        bend = ("phase defocus / rad", "phase spherical / rad")
        missed.append(
            np.array(
                [
                    (v - want[name]) / s
                    for name, (v, s) in rows.items()
                    if name not in bend
                ]
            )
        )
    assert math.sqrt((missed[0] ** 2).mean()) < 1.5  # of 21
    assert np.abs(missed[0]).max() < 3.5
    assert np.abs(missed[1]).max() > 8.0
    rest = (
        np.array(
            [
                v
                for n, v in zip(found.names, found.value, strict=True)
                if n.startswith("stage")
            ]
        )
        - OFF
    )
    # 4 nm each
    assert abs(rest - np.polyval(np.polyfit(Z, rest, 1), Z)).max() < 0.012
    assert not any(name.startswith("stage") for name in exact.names)


def test_stage_errors_are_a_tenth_of_the_step_unless_stated():
    made = [PupilModel(replace(SPEC, stage_sigma_um=s), Z) for s in (math.nan, 0.07)]
    assert [one.stage_sigma_um for one in made] == pytest.approx([0.03, 0.07])
    for bad in (-0.1, math.inf):
        with pytest.raises(FitError, match="stage_sigma_um"):
            replace(SPEC, stage_sigma_um=bad)
