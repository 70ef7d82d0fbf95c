"""How a tolerance is met: the settings that are tried, and every part of the error that
is told, with typed results.
"""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.propagate import SHARE, PropagationCase
from metalens.psf import compute
from metalens.psf.compute import IntensityResult

CASE = PropagationCase(
    (30, 41),
    0.37,
    0.85,
    62.0,
    (0.21, -0.13),
    (1 / 400, 1 / 900),
    (14.0, -8.5),
    0.6,
    (9, 11),
)
SIMPLE = SimpleNamespace(carrier=SimpleNamespace(rounding_rad=0.0))
OTHER = PropagationCase(
    (30, 41),
    0.37,
    0.79,
    62.0,
    (0.21, -0.13),
    (1 / 400, 1 / 900),
    (14.0, -8.5),
    0.6,
    (9, 11),
)


def maps(dtype, count=1):
    rng = np.random.default_rng(3)
    return tuple(
        torch.from_numpy(rng.uniform(0.1, 1, (count, 30, 41))).to(dtype)
        for _ in range(2)
    )


def scripted(monkeypatch, *results):
    """``_windowed`` gives these (error, brightness) in turn; what it was asked for:
    (dtype, setting).
    """
    asked, left = [], list(results)

    def windowed(lit, dtype, tolerance, moving):
        asked.append((dtype, tolerance))
        error, bright = left.pop(0)
        return IntensityResult(
            torch.ones(2, 9, 11, dtype=torch.float64),
            error,
            "typed",
            7.0,
            brightness=bright,
        )

    monkeypatch.setattr(compute, "_windowed", windowed)
    monkeypatch.setattr(
        compute,
        "choose_method",
        lambda *given, **more: SimpleNamespace(method="windowed"),
    )
    return asked


SINGLE, DOUBLE = torch.float32, torch.float64


def run(dtype=SINGLE, tolerance=1e-3, case=CASE, **more):
    return compute.compute_intensity(
        *maps(dtype), [case], [1.0], tolerance=tolerance, **more
    )


def test_one_try_at_half_the_tolerance_adds_what_sums_and_results_round(monkeypatch):
    asked = scripted(monkeypatch, (6e-4, 500.0))
    found = run()
    assert asked == [(SINGLE, 5e-4)]
    assert found.error == pytest.approx(math.hypot(6e-4, 4e-7, 1.5e-7), rel=1e-12)
    assert (found.intensity.dtype, found.power) == (SINGLE, 7.0)
    tight = scripted(monkeypatch, (1e-7, 500.0))
    assert run(tolerance=9e-7).error == pytest.approx(
        math.hypot(1e-7, 4e-7, 1.5e-7), rel=1e-9
    )
    assert tight == [(SINGLE, 4.5e-7)]
    double = scripted(monkeypatch, (1e-14, 500.0))
    assert run(DOUBLE, 1e-9).error == pytest.approx(math.hypot(1e-14, 2e-15), rel=1e-9)
    assert double == [(DOUBLE, 5e-10)]


def test_what_single_precision_cannot_hold_is_summed_in_double(monkeypatch):
    asked = scripted(monkeypatch, (1e-7, 500.0))
    assert run(tolerance=7e-7).error == pytest.approx(
        math.hypot(1e-7, 2e-15, 1.5e-7), rel=1e-9
    )
    assert asked == [(DOUBLE, 3.5e-7)]
    few = scripted(
        monkeypatch, (1e-4, 500.0)
    )  # 7 x 9 samples have no mean rounding, 8 x 8 have
    run(
        case=PropagationCase(
            (30, 41),
            0.37,
            0.85,
            62.0,
            (0.2, 0.1),
            (0.002, 0.001),
            (14.0, -8.5),
            0.6,
            (7, 9),
        )
    )
    assert few == [(DOUBLE, 5e-4)]
    enough = scripted(monkeypatch, (1e-4, 500.0))
    run(
        case=PropagationCase(
            (30, 41),
            0.37,
            0.85,
            62.0,
            (0.2, 0.1),
            (0.002, 0.001),
            (14.0, -8.5),
            0.6,
            (8, 8),
        )
    )
    assert enough == [(SINGLE, 5e-4)]


def test_tries_get_tighter_until_the_estimate_is_met_and_the_last_is_told_in_any_case(
    monkeypatch,
):
    asked = scripted(monkeypatch, (2e-3, 500.0), (1.1e-3, 500.0), (1.05e-3, 500.0))
    assert run().error == pytest.approx(1.05e-3, rel=1e-6)
    assert asked == [
        (SINGLE, 5e-4),
        (SINGLE, pytest.approx(1.25e-4)),
        (DOUBLE, pytest.approx(1e-5)),
    ]
    asked = scripted(monkeypatch, (2e-3, 500.0), (0.9e-3, 500.0))
    assert run().error == pytest.approx(0.9e-3, rel=1e-6)
    assert len(asked) == 2


@pytest.mark.parametrize(("bright", "tries"), [(31.0, 1), (29.0, 2)])
def test_dim_windows_are_summed_again_in_double(monkeypatch, bright, tries):
    asked = scripted(monkeypatch, (1e-4, bright), (1e-4, bright))
    run()
    assert [dtype for dtype, _ in asked] == [SINGLE, DOUBLE][:tries]


def test_gradients_ask_for_tighter_settings(monkeypatch):
    """A thirty-second of the tolerance or 1e-6, not above an eighth; a moving geometry
    a thousandth, in double.
    """
    for tolerance, want in ((1e-3, 1e-3 / 32), (2e-5, 1e-6), (4e-6, 5e-7)):
        asked = scripted(monkeypatch, (0.0, 500.0))
        phase, level = maps(SINGLE)
        compute.compute_intensity(
            phase.requires_grad_(), level, [CASE], [1.0], tolerance=tolerance
        )
        assert asked == [(SINGLE, pytest.approx(want))]
    asked = scripted(monkeypatch, (0.0, 500.0))
    run(moving=object())
    assert asked == [(DOUBLE, pytest.approx(1e-6))]


def summed(phase, level, case):
    """(depth, y, x) |U|² of spheres from sources 400 and 900 um away through every
    pillar: Rayleigh and Sommerfeld.
    """
    (x, y), k = (
        np.meshgrid(*((np.arange(n) - (n - 1) / 2) * 0.37 for n in (41, 30))),
        2 * math.pi / case.wavelength_um,
    )
    found = []
    for z in (400.0, 900.0):
        light = level * np.exp(
            1j
            * (phase + k * np.sqrt((x + 0.21 * z) ** 2 + (y - 0.13 * z) ** 2 + z * z))
        )
        for v in -8.5 + 0.6 * np.arange(-4, 5):
            for u in 14.0 + 0.6 * np.arange(-5, 6):
                r = np.sqrt((x - u) ** 2 + (y - v) ** 2 + 62.0**2)
                kernel = (
                    0.37**2
                    * 62.0
                    / (2 * math.pi * r * r)
                    * (1 / r - 1j * k)
                    * np.exp(1j * k * r)
                )
                found.append(abs((light * kernel).sum()) ** 2)
    return np.reshape(found, (2, 9, 11))


def test_exact_sums_add_wavelengths_by_their_weights():
    phase, level = maps(DOUBLE, 2)
    each = [
        summed(p, t, case)
        for p, t, case in zip(phase.numpy(), level.numpy(), (CASE, OTHER), strict=True)
    ]
    want, squares = 0.7 * each[0] + 0.4 * each[1], (level**2).sum((1, 2))
    double = compute.compute_intensity(
        phase, level, [CASE, OTHER], [0.7, 0.4], tolerance=1e-3
    )
    assert double.intensity.numpy() == pytest.approx(
        want, rel=1e-9, abs=1e-12 * want.max()
    )  # 7000 rad in float64
    assert double.power == pytest.approx(
        float(0.7 * squares[0] + 0.4 * squares[1]), rel=1e-12
    )
    assert double.error == pytest.approx(4e-12, rel=1e-3)
    assert double.reason.startswith("exact sum: 1,230 pillars at 99 points")
    single = compute.compute_intensity(
        *maps(SINGLE, 2), [CASE, OTHER], [0.7, 0.4], tolerance=1e-3
    )
    assert single.error == pytest.approx(1e-7)


def test_pillars_of_random_phases_add_by_power_at_the_middle_of_the_window():
    """|area d / (2π r²) (1/r - ik)| of the kernel from the lens's middle to that of the
    window, root of the power.
    """
    r = math.hypot(62.0, 14.0, 8.5)
    k = 2 * math.pi / 0.85
    kernel = 0.37**2 * 62.0 / (2 * math.pi * r**2) * abs(1 / r - 1j * k)
    assert compute._incoherent(5.3, CASE) == pytest.approx(
        math.sqrt(5.3) * kernel, rel=1e-5
    )


def test_an_estimate_looks_at_few_of_the_samples_of_windows_above_a_size(monkeypatch):
    """9 x 11 samples are 99: more than 98, and not more than 99. Gradients begin at a
    32nd of the tolerance.
    """
    phase, level = maps(SINGLE)
    error = {}
    for many in (98, 99):
        monkeypatch.setattr(compute, "MANY", many)
        found = compute.compute_intensity(
            phase.requires_grad_(), level, [CASE], [1.0], tolerance=4e-3
        )  # not by the exact sum
        assert found.reason.startswith("windowed")
        error[many] = found.error
    assert error[98] == pytest.approx(
        math.hypot(1.5 * error[99], 0.02 * 4e-3 / 32), rel=1e-4
    )  # beside 4e-7 of sums


def test_few_of_many_samples_may_miss_half_as_much_again_and_a_part_of_the_setting():
    found = compute._few_seen(IntensityResult(torch.ones(1), 3e-4, "typed", 1.0), 8e-3)
    assert found.error == pytest.approx(math.hypot(1.5 * 3e-4, 0.02 * 8e-3), rel=1e-12)


def test_a_wide_window_tells_noise_brightness_and_transforms(monkeypatch):
    """Two wavelengths: light and power by weight, noise of each from its own power,
    error of few samples and FFTs.
    """
    kept = []
    light = {0.85: 3.0, 0.79: 5.0}
    power = {0.85: 900.0, 0.79: 700.0}
    bright = torch.ones(2, 9, 11, dtype=SINGLE)
    bright[:, 3, 4] = 21.0
    monkeypatch.setattr(
        compute,
        "plan_wide",
        lambda case, *_: SimpleNamespace(nodes_um=None, case=case, moments=SIMPLE),
    )
    monkeypatch.setattr(
        compute,
        "light_wide",
        lambda maps, made, pupils: (
            bright * light[made.case.wavelength_um],
            torch.ones(1, 5, 6, dtype=torch.complex64),
            [power[made.case.wavelength_um]],
        ),
    )
    monkeypatch.setattr(
        compute,
        "relative_error",
        lambda samples, seen: kept.append((samples, seen)) or 4e-4,
    )
    choice = SimpleNamespace(method="wide", reason="typed")
    found = compute._wide(
        compute.IntensityRequest(*maps(SINGLE, 2), [CASE, OTHER], [0.7, 0.4]),
        SINGLE,
        8e-3,
        choice,
    )
    own = math.hypot(math.hypot(1.5 * 4e-4, 0.02 * 8e-3), 1e-6)
    assert found.error == pytest.approx(own, rel=1e-12)
    total = 0.7 * 3 + 0.4 * 5
    assert found.intensity[1, 3, 4].item() == pytest.approx(21 * total, rel=1e-6)
    assert found.power == pytest.approx(0.7 * 900 + 0.4 * 700)
    (samples,), (seen,) = kept[0]
    assert seen == pytest.approx(bright.numpy() * total)
    for sample, case, weight in zip(samples, (CASE, OTHER), (0.7, 0.4), strict=True):
        phasor = math.hypot(8e-7, 8e-3 / SHARE)
        assert sample.noise == pytest.approx(
            phasor * compute._incoherent(power[case.wavelength_um], case), rel=1e-9
        )
        assert (sample.weight, sample.case, sample.parts) == (weight, case, 1)
    lit = (98 * 1 + 21**2) / (98 + 21) * total  # of the light itself: Σ I² / Σ I
    alone = (
        0.7 * compute._incoherent(1.0, CASE) ** 2
        + 0.4 * compute._incoherent(1.0, OTHER) ** 2
    )
    assert found.brightness == pytest.approx(lit / alone / found.power, rel=1e-5)
    plain = compute._judged(
        bright * total,
        [samples],
        [seen],
        ([CASE, OTHER], [0.7, 0.4], found.power),
        SimpleNamespace(method="windowed", reason=""),
    )
    assert plain.brightness == pytest.approx(
        (98 + 21) / 99 * total / alone / found.power, rel=1e-5
    )
    assert plain.error == 4e-4


def faint():
    """Pillars in turn of opposite signs under a Gaussian: fields that cancel to some
    1e-4 of their sum.
    """
    y, x = np.mgrid[:30, :41]
    level = np.exp(-(((x - 20) * 0.37 / 3.1) ** 2) - (((y - 14.5) * 0.37 / 2.4) ** 2))
    return np.where((x + y) % 2, math.pi, 0.0)[None], level[None]


def test_an_exact_sum_of_light_that_cancels_is_as_wrong_as_it_says():
    """Against the same sum in numbers of 64 binary digits, 2000 times as fine: rounding
    of thousands of radians.
    """
    phase, level = faint()
    found = compute.compute_intensity(
        torch.from_numpy(phase), torch.from_numpy(level), [CASE], [1.0], tolerance=1e-3
    )
    assert found.reason.startswith("exact sum")
    fine = np.longdouble
    x, y = np.meshgrid(
        *((np.arange(n, dtype=fine) - fine(n - 1) / 2) * fine(0.37) for n in (41, 30))
    )
    k = 4 * np.arccos(fine(0)) / fine(0.85)
    want = np.zeros((2, 9, 11), fine)
    for d, z in enumerate((fine(1) / fine(1 / 400), fine(1) / fine(1 / 900))):
        source = (x + fine(0.21) * z) ** 2 + (y + fine(-0.13) * z) ** 2 + z * z
        light = level[0].astype(fine) * np.exp(
            1j * (phase[0].astype(fine) + k * np.sqrt(source))
        )
        for i, j in np.ndindex(9, 11):
            u, v = fine(14.0) + fine(0.6) * (j - 5), fine(-8.5) + fine(0.6) * (i - 4)
            r = np.sqrt((x - u) ** 2 + (y - v) ** 2 + fine(62.0) ** 2)
            want[d, i, j] = (
                np.abs((light * (1 / r - 1j * k) * np.exp(1j * k * r) / r**2).sum())
                ** 2
            )
    seen, want = (
        a / a.sum((1, 2))[:, None, None]
        for a in (found.intensity.numpy().astype(fine), want)
    )
    true = float(np.sqrt(((seen - want) ** 2).sum() / (want**2).sum()))
    assert (
        8e-12 < true < found.error < 1e3 * true
    )  # rounding counts in full on a part of the pillars alone


def test_noise_beside_a_field_errs_light_by_its_part_along_the_field():
    """Drawn 4000 times: 1.1 % of a mean square. Twice the mean is told, since few
    pillars vary about it.
    """
    rng = np.random.default_rng(8)
    field = (
        rng.normal(size=(2, 3, 4))
        + 1j * rng.normal(size=(2, 3, 4)) * np.array([0.4, 2.0])[:, None, None]
    )
    light, noise = np.abs(field) ** 2, 0.003
    drawn = (
        noise
        / math.sqrt(2)
        * (rng.normal(size=(4000, 2, 3, 4)) + 1j * rng.normal(size=(4000, 2, 3, 4)))
    )
    whole = light.sum((1, 2))[:, None, None]
    change = (np.abs(field + drawn) ** 2 - light) / whole
    want = math.sqrt((change**2).sum() / 4000 / ((light / whole) ** 2).sum())
    assert compute._noisy_sum(light, noise) == pytest.approx(2 * want, rel=0.04)


def test_components_of_both_polarisations_are_asked_for_at_the_pillars_rows_and_columns():
    asked = []
    (phase, level), rows, columns = maps(DOUBLE), 30, 41
    made = compute._of_pillars(
        (phase, level), CASE, 0.7, lambda y, x: asked.append((y, x)) or "components"
    )
    assert made.pupils == "components"
    ((y, x),) = asked
    assert np.ravel(y) == pytest.approx(
        (np.arange(rows) - (rows - 1) / 2) * 0.37, abs=1e-12
    )
    assert np.ravel(x) == pytest.approx(
        (np.arange(columns) - (columns - 1) / 2) * 0.37, abs=1e-12
    )


def test_windows_above_eight_thousand_samples_are_looked_at_in_few(monkeypatch):
    """64 x 128 samples are all looked at; of 3 x 2731, one more, what may be missed is
    added.
    """
    (phase, level), as_it_is = maps(SINGLE), compute.MANY
    for shape, more in (((64, 128), False), ((3, 2731), True)):
        case = dataclasses.replace(CASE, step_um=0.02, samples=shape)
        found = []
        for many in (as_it_is, 10**9):
            monkeypatch.setattr(compute, "MANY", many)
            found.append(
                compute._windowed(
                    compute.IntensityRequest(phase, level, [case], [1.0]),
                    SINGLE,
                    4e-3,
                    None,
                ).error
            )
        assert (found[0] > found[1]) is more
