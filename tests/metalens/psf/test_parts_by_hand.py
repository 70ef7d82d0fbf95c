"""Parts of a PSF's light and of its error, each by hand: noise of pillars, the darkest depth, faces that are passed."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens import psf
from metalens.ground.errors import PropagationError
from metalens.lens import Media
from metalens.propagate import Case, Moving, blocks
from metalens.psf import compute, direction, spectrum
from metalens.psf.compute import Result

CASE = Case((30, 41), 0.37, 0.85, 62.0, (0.21, -0.13), (1 / 400, 1 / 900), (14.0, -8.5), 0.6, (9, 11))
OTHER = Case((30, 41), 0.37, 0.79, 62.0, (0.21, -0.13), (1 / 400, 1 / 900), (14.0, -8.5), 0.6, (9, 11))


def test_a_phasor_errs_by_arithmetic_interpolation_and_long_paths():
    made = SimpleNamespace(moments=SimpleNamespace(carrier=SimpleNamespace(rounding_rad=3e-4)))
    got = compute._phasor(torch.float32, 4e-3, made)  # a fortieth of the setting
    assert got == pytest.approx(math.hypot(8e-7, 1e-4, 3e-4), rel=1e-12)


def test_light_that_rounds_is_that_of_every_component_at_its_largest_factor():
    """Two components of three maps: squares of the largest factors times the maps' sums of squares."""
    factors = np.zeros((2, 3, 4, 5))
    factors[0, 0, 1, 2], factors[0, 0, 3, 3], factors[0, 2, 0, 0], factors[1, 1, 2, 2] = 0.3, -0.7, 1.2, 0.4
    powers = [10.0, 20.0, 50.0]
    got = compute._noisy(powers, (np.array([1.0, -1.0]), factors))
    assert got == pytest.approx(0.49 * 10 + 1.44 * 50 + 0.16 * 20, rel=1e-12)
    assert compute._noisy([7.0], None) == 7.0


def test_errors_of_a_result_add_as_squares():
    assert Result(torch.ones(1), 0.02, "", 1.0, sampling=0.03, source=0.06).whole == pytest.approx(0.07, rel=1e-12)


@pytest.mark.parametrize("method", ["windowed", "wide"])
def test_brightness_is_that_of_the_darkest_depth(monkeypatch, method):
    """Mean light, or Σ I² / Σ I of a wide window, over that of random phases."""
    monkeypatch.setattr(compute, "relative_error", lambda samples, seen: 1e-4)
    total = torch.full((3, 9, 11), 2.0, dtype=torch.float64)
    total[1], total[2, 4, 5] = 0.5, 40.0
    found = compute._judged(total, [], [], ([CASE], [1.0], 9.0), SimpleNamespace(method=method, reason=""))
    assert found.brightness == pytest.approx(0.5 / compute._incoherent(9.0, CASE) ** 2, rel=1e-9)


def test_power_of_windows_is_weighed_by_the_light_of_the_wavelengths():
    phase, level = (torch.from_numpy(np.random.default_rng(3).uniform(0.1, 1, (2, 30, 41))) for _ in range(2))
    found = compute._windowed(compute.Lit(phase, level, [CASE, OTHER], [0.7, 0.4]), torch.float64, 1e-4, None)
    squares = (level**2).sum((1, 2)).tolist()
    assert found.power == pytest.approx(0.7 * squares[0] + 0.4 * squares[1], rel=1e-9)


def test_the_flux_of_an_exact_sum_is_that_of_the_window():
    """Components of the flux add with their signs, however the light is summed; from the side, at NA 0.6."""
    y, x = (np.indices((40, 40)) - 19.5) * 0.4
    phase = -2 * np.pi / 0.85 * np.sqrt(x**2 + y**2 + 11.0**2)
    about = dict(pitch_um=0.4, wavelength_um=0.85, sensor_distance_um=11.0, depths_um=[np.inf], angle_rad=(0.3, -0.2))
    about |= dict(window_um=0.6, samples=2, tolerance=1e-5, polarisation="flux", integrate=False, offset_um=(0.9, 0.4))
    exact = psf.psf_stack(phase, np.ones_like(phase), **about)
    assert exact.reason.startswith("exact")
    window = psf.psf_stack(torch.tensor(phase, requires_grad=True), torch.ones(40, 40, dtype=torch.float64), **about)
    assert window.reason.startswith("windowed")
    assert exact.energy_um2 == pytest.approx(window.numpy().energy_um2, rel=1e-4)


def test_a_moving_window_is_seen_from_its_tile():
    moving = Moving(torch.zeros(2), torch.ones(1), torch.tensor(62.0), torch.tensor([14.0, -8.5], dtype=torch.float64))
    tile = Case((30, 41), 0.37, 0.85, 62.0, (0.21, -0.13), (1 / 400,), (15.2, -9.1), 0.6, (3, 4))
    assert compute._shifted(moving, CASE, tile).centre.tolist() == pytest.approx([15.2, -9.1])
    assert compute._shifted(moving, CASE, CASE) is moving


def test_faces_let_through_what_fresnel_has_for_the_chief_ray():
    """From a gel of 1.37 into glass of 1.52, light from (0.21, -0.13) in air: mean of both polarisations."""
    behind = Media((1.37, 1.52), (40.0, 22.0))
    case = Case((30, 41), 0.37, 0.85, 62.0, (0.21, -0.13), (1 / 400,), (9.0, -6.0), 0.6, (3, 4), behind=behind)
    slope = math.hypot(0.21, 0.13)
    sine = math.sin(math.atan(slope))
    inner, outer = math.asin(sine / 1.37), math.asin(sine / 1.52)
    s = (math.sin(inner - outer) / math.sin(inner + outer)) ** 2
    p = (math.tan(inner - outer) / math.tan(inner + outer)) ** 2
    assert direction._passed(case) == pytest.approx(1 - (s + p) / 2, rel=1e-9)
    assert direction._passed(CASE) == 1.0


def test_a_rule_has_the_whole_weight_and_a_narrow_line_201_points():
    points, share = np.linspace(0.8, 0.9, 41), np.full(41, 3.7 / 41)
    where, weight = spectrum.gauss(points, share, 4)
    assert weight.sum() == pytest.approx(3.7, rel=1e-12)
    assert weight @ where**3 == pytest.approx(share @ points**3, rel=1e-12)
    assert len(spectrum.weight(spectrum.Source(850.0, 3.0))[0]) == 201  # 5 widths in fortieths


TAILS = [(800, 5e-5), (810, 5e-5), (810.25, 2e-4), (850, 1.0), (889.75, 3e-4), (890, 9e-5), (900, 9e-5)]


def test_what_a_measured_spectrum_leaves_out_beyond_the_pillars_is_told(tmp_path):
    """Tails below a ten-thousandth of the peak: kept where the pillars are known, else a share of the light that no
    rule makes up for. Areas of the tails by hand, of all by trapezoids, which the rows bound."""
    file = tmp_path / "led.csv"
    file.write_text("\n".join(f"{nm},{value}" for nm, value in TAILS))
    whole = spectrum.measured([file], within_um=(0.7, 1.0))
    nm, value = np.array(TAILS).T
    assert whole.beside == 0.0
    assert whole.wavelengths_um[[0, -1]] * 1e3 == pytest.approx([800.05, 899.95], abs=0.01)
    area = np.trapezoid(value, nm)
    assert whole.share @ whole.wavelengths_um * 1e3 == pytest.approx(
        sum(np.diff(nm) * (value[1:] + value[:-1]) / 2 * _middles(nm, value)) / area, rel=1e-12
    )
    less = spectrum.measured([file], within_um=(0.8101, 0.88996))
    assert less.beside == pytest.approx((10 * 5e-5 + 10 * 9e-5) / area, rel=0.05)  # and pieces of two slopes
    assert spectrum.nodes(less, path_um=0.0, tolerance=1e-3).error == pytest.approx(less.beside)
    with pytest.raises(PropagationError, match=r"light from 810\.\d+ to 889\.\d+ nm, the pillars are known from 820"):
        spectrum.measured([file], within_um=(0.82, 0.95))


def _middles(nm, value):
    """Centroids of trapezoids."""
    a, b = value[:-1], value[1:]
    return nm[:-1] + np.diff(nm) * (a + 2 * b) / (3 * (a + b))


def test_lines_narrower_than_the_step_between_points_are_seen(tmp_path):
    """A laser of 0.2 nm beside a diode: shares are those of the areas 0.1 * 40 and 10."""
    laser, led = tmp_path / "laser.csv", tmp_path / "flat.csv"
    laser.write_text("840,1\n849.9,1\n850.0,41\n850.1,1\n850.2,1\n850.3,1\n850.4,1\n")
    led.write_text("840.1 1\n850.1 1\n")
    found = spectrum.measured([laser, led], within_um=(0.8, 0.9))
    line = found.share[np.abs(found.wavelengths_um * 1e3 - 850.0) < 0.1].sum()
    assert line == pytest.approx((4.0 + 0.2) / (4.0 + 10.0), rel=1e-9)
    alone = tmp_path / "alone.csv"
    alone.write_text("849.93,0\n849.95,1\n849.97,0\n")
    assert spectrum.measured([alone], within_um=(0.8, 0.9)).wavelengths_um.mean() == pytest.approx(0.84995, rel=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        "nm;power\n840,5;0,3\n850,5;1,0\n860;0,2\n",
        "840,5\t0,3\n850,5\t1,0\n860\t0,2\n",
        "840,5 0,3 0,01\n850,5 1,0 0,01\n860,0 0,2 0,01\n",
        "840.5, 0.3, 0.01\r\n850.5, 1.0, 0.01\r\n860, 0.2, 7\r\n",
        "\ufeff860,0.2\n850.5,1\n840.5,0.3\n",
        "840.5 0.3\n850.5 1\n860 0.2",
    ],
)
def test_a_decimal_comma_is_told_from_one_that_parts_columns(tmp_path, text):
    file = tmp_path / "led.csv"
    file.write_bytes(text.encode())
    assert spectrum._curve(file).tolist() == [[840.5, 0.3], [850.5, 1.0], [860.0, 0.2]]


def needed(shape, kernel, axis=0):
    """Nodes that a kernel asks for in blocks of 32 pillars."""
    case = Case(shape, 0.4, 0.85, 62.0, (0.0, 0.0), (1 / 400,), (0.0, 0.0), 0.6, (3, 3))
    return blocks._needed(case, axis, 32, kernel, 1e-5, 0).nodes


def test_blocks_at_both_ends_have_the_nodes_that_they_need():
    """Light that bends at one end of the lens alone: as many nodes whichever end that is."""
    ends = [needed((320, 60), lambda y, x, s=s: np.exp(0.3j * np.exp(s * y / 12)) + 0 * x) for s in (1, -1)]
    assert ends[0] == ends[1]
    assert ends[0] > needed((320, 60), lambda y, x: np.exp(0.3j * np.exp(-np.abs(y) / 12)) + 0 * x)


def test_blocks_are_looked_at_across_the_whole_lens():
    """Fringes along y that are finer the farther off the axis they lie, exp(i x y / 9): half as wide, fewer nodes."""
    for axis in (0, 1):
        shape = (64, 160) if axis == 0 else (160, 64)
        wide, narrow = (needed(s, lambda y, x: np.exp(1j * x * y / 9), axis) for s in (shape, (64, 64)))
        assert wide > narrow


def test_wavelengths_are_as_few_as_tell_every_path_of_two_lines():
    """Lines of 0.3 at 0.84 um and 0.7 at 0.86 um: their mean alone errs most over the longest of 65 paths that it is
    asked for, two tell all."""
    lines, share, reach = np.array([0.84, 0.86]), np.array([0.3, 0.7]), 7.0
    mean = float(lines @ share)
    p = reach * np.arange(65) / 64
    miss = max(abs(np.exp(2j * np.pi * a / mean) - share @ np.exp(2j * np.pi * a / lines)) for a in p)
    assert miss > 0.05
    source = spectrum.Measured(lines, share)
    one = spectrum.nodes(source, path_um=reach, tolerance=1.001 * miss)
    assert one.wavelengths_um == pytest.approx([mean])
    assert one.error == pytest.approx(miss, rel=1e-9)
    two = spectrum.nodes(source, path_um=reach, tolerance=0.999 * miss)
    assert np.sort(two.wavelengths_um) == pytest.approx(lines, rel=1e-12)
    assert two.weights.sum() == pytest.approx(1, rel=1e-12)
    assert two.error < 1e-9


def test_a_line_has_half_its_light_half_a_width_away():
    """Behind thick silicon every photon counts, so light of equal power counts by its wavelength."""
    um, share = spectrum.weight(spectrum.Source(850.0, 30.0, silicon_um=1e6))
    level = np.interp([0.850, 0.835, 0.865, 0.880], um, share)
    assert level[1:] / level[0] == pytest.approx(np.array([835, 865, 880]) / 850 * [0.5, 0.5, 1 / 16], rel=1e-9)
    assert (um[0], um[-1]) == pytest.approx((0.775, 0.925), rel=1e-12)
    assert share.sum() == pytest.approx(1, rel=1e-12)
