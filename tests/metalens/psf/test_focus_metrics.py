"""FWHM, Strehl ratio, MTF50 and focusing efficiency against the Airy pattern and plain
Rayleigh-Sommerfeld sums written here.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from metalens import design, lens, psf
from metalens.cell.record import Cell
from tests.command_line import call, printed
from tests.proxies import proxy_of

WAVE, PITCH, FOCAL, LEVEL = 0.78, 0.37, 210.0, 0.86
PROXY = proxy_of([np.pi, np.pi], [LEVEL, 0.0], (0.1, 0.3), WAVE)


def flat_lens(n=180, source_um=np.inf, aside_um=0.0, error_rad=0.0):
    """A hyperbolic lens whose pillars give every phase, one |T|; its focus lies
    ``aside_um`` along x. ``error_rad``: of alternate columns, up and down.
    """
    x = (np.arange(n) - (n - 1) / 2) * PITCH
    r2 = x**2 + x[:, None] ** 2
    path = np.sqrt((x - aside_um) ** 2 + x[:, None] ** 2 + FOCAL**2)
    if np.isfinite(source_um):
        path = path + np.sqrt(r2 + source_um**2)
    phase = -2 * np.pi / WAVE * path + error_rad * (-1.0) ** np.arange(n)
    part = np.mod(phase, 2 * np.pi) / (2 * np.pi)
    diameter = np.where(r2 < (n * PITCH / 2) ** 2, 0.1 + 0.2 * part, 0)
    return lens.Lens(
        lens.DiameterMap(diameter, PITCH),
        Cell(pitch_um=PITCH),
        PROXY,
        WAVE,
        FOCAL,
        source_um,
        "hyperbolic",
    )


def plain_irradiance(made, x_um, y_um):
    """|Σ p² T e^{iφ} d/(2πr²) (1/r - ik) e^{ikr}|² for a plane wave along the axis."""
    d, k, z = made.diameters, 2 * np.pi / WAVE, made.sensor_distance_um
    there = np.asarray(d.diameter_um) > 0
    px, py = (np.broadcast_to(a, there.shape)[there] for a in (d.x_um, d.y_um[:, None]))
    phase = made.phase_rad()[there]
    x_um, y_um = np.broadcast_arrays(x_um, y_um)
    light = []
    for x, y in zip(x_um.ravel(), y_um.ravel(), strict=True):
        r = np.sqrt((px - x) ** 2 + (py - y) ** 2 + z**2)
        h = z / (2 * np.pi * r**2) * (1 / r - 1j * k) * np.exp(1j * (k * r + phase))
        light.append(abs(PITCH**2 * LEVEL * h.sum()) ** 2)
    return np.reshape(light, x_um.shape)


def view(made, **more):
    return psf.View((np.inf,), **({"window_um": 60.0, "samples": 256} | more))


def test_the_diffraction_limit_is_the_airy_pattern():
    """Half maximum at v = 1.6163 (Born and Wolf 8.5.2), the ideal MTF at half, and the
    encircled energy 1 - J0² - J1² within three FWHM across, integrated here.
    """
    limit = psf.diffraction_limit(0.31, 0.94)
    assert limit.fwhm_um == pytest.approx(1.0290 * 0.94 / (2 * 0.31), rel=1e-4)
    assert limit.cutoff_per_um == pytest.approx(2 * 0.31 / 0.94)
    s = limit.mtf50_per_um / limit.cutoff_per_um
    ideal = 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))
    assert ideal == pytest.approx(0.5, abs=1e-6)
    r = np.linspace(1e-9, 1.5 * limit.fwhm_um, 20_001)
    v = 2 * np.pi * 0.31 / 0.94 * r
    power = np.trapezoid((2 * special.j1(v) / v) ** 2 * v, v) / 2
    assert limit.efficiency == pytest.approx(power, abs=1e-6)  # all of it: ∫ = 2


def test_a_perfect_lens_has_the_airy_figures_and_the_loss_of_its_pillars():
    """NA 0.157. Pillars that pass |T|² = 0.74 leave the Strehl ratio at 1 and 0.74 x
    0.855 of the light in the focus. Errors: the sine condition is off by NA²/4 = 6e-3
    of the width, the staircase of the rim by 2e-3 of the area.
    """
    made = flat_lens()
    stack = psf.from_lens(made, view(made))
    (found,) = psf.focus_metrics(stack, made)
    sine = np.sin(np.arctan(180 * PITCH / 2 / FOCAL))
    assert found.limit.fwhm_um == pytest.approx(1.029 * WAVE / (2 * sine), rel=5e-3)
    assert found.fwhm_um == pytest.approx(found.limit.fwhm_um, rel=0.01)
    assert found.strehl == pytest.approx(1, abs=2e-3)
    assert found.efficiency == pytest.approx(LEVEL**2 * 0.855, rel=0.01)
    assert found.mtf50_per_um == pytest.approx(
        (found.limit.mtf50_per_um,) * 2, rel=0.015
    )
    assert 0 < found.efficiency_error < 0.05
    assert found.window_share > 0.97


def test_phase_errors_of_the_pillars_lower_strehl_and_efficiency_by_cos_squared():
    """Columns 0.7 rad up and down send 1 - cos² into orders of twice the pitch, far
    from the focus.
    """
    made = flat_lens(error_rad=0.7)
    stack = psf.from_lens(made, view(made))
    (found,) = psf.focus_metrics(stack, made)
    assert found.strehl == pytest.approx(np.cos(0.7) ** 2, rel=5e-3)
    assert found.efficiency == pytest.approx(
        np.cos(0.7) ** 2 * LEVEL**2 * 0.855, rel=0.01
    )


def test_figures_of_a_defocused_lens_are_those_of_a_plain_sum():
    """Radial means and encircled power of a plain sum on rings about the axis; the
    budget of the PSF gives no more than 1e-3 here.
    """
    made = replace(flat_lens(n=120), sensor_distance_um=FOCAL + 9.0)
    stack = psf.from_lens(made, view(made, window_um=80.0))
    (found,) = psf.focus_metrics(stack, made)
    radii = np.linspace(0, 8, 161)
    turn = 2 * np.pi * np.arange(8) / 8 + 0.1
    ring = radii[:, None] * np.stack([np.cos(turn), np.sin(turn)])[:, None]
    mean = plain_irradiance(made, *ring).mean(1)
    half = 2 * np.interp(-0.5, -mean / mean[0], radii)
    assert found.fwhm_um == pytest.approx(half, rel=3e-3)
    inside = radii <= 1.5 * half
    fine = np.linspace(0, 1.5 * half, 4001)
    power = 2 * np.pi * np.trapezoid(np.interp(fine, radii, mean) * fine, fine)
    there = np.asarray(made.diameters.diameter_um) > 0
    area = PITCH**2 * there.sum()
    assert inside.any()
    assert found.efficiency == pytest.approx(power / area, rel=5e-3)
    # all pillars in phase on the axis
    d, k, z = made.diameters, 2 * np.pi / WAVE, made.sensor_distance_um
    r = np.sqrt(d.x_um**2 + d.y_um[:, None] ** 2 + z**2)[there]
    level = (PITCH**2 * LEVEL * z / (2 * np.pi * r**2) * abs(1 / r - 1j * k)).sum()
    assert found.strehl == pytest.approx(mean[0] / level**2, rel=3e-3)


@pytest.fixture
def saved(tmp_path):
    def save(**how):
        lens.save(tmp_path / "lens.h5", flat_lens(**how))
        return tmp_path

    return save


def run(folder, *more):
    return call(f"psf {folder}/lens.h5 -o {folder}/p.h5", *more)


def test_a_lens_for_collimated_light_is_looked_at_from_infinity(saved, capsys):
    """Default: infinity, on the axis and where its hyperbolic phase keeps a Strehl
    ratio of 0.8, and planes behind the lens; pictures that would be empty are left out.
    """
    folder = saved()
    assert run(folder, "--json") == 0
    said = printed(capsys)
    assert said["depths_um"] == [None]
    assert said["angles_rad"][0] == [0, 0]
    axis, rim = said["focus"]
    assert axis["strehl"] == pytest.approx(1, abs=0.01)
    assert rim["strehl"] == pytest.approx(0.8, abs=0.03)  # Maréchal's criterion
    assert rim["window_share"] > 0.9
    scan = said["z_scan"]
    assert len(scan["shift_um"]) == 21
    # focal shift of a Fresnel number of 6.8: a few percent of the depth of focus
    assert abs(scan["best_um"]) < 0.15 * WAVE / 0.157**2
    assert scan["peak"][0] < 0.3 * max(scan["peak"])
    assert (folder / "p_zscan.png").exists()
    assert (folder / "p_montage.png").exists()
    assert not (folder / "p_xz.png").exists()


def test_planes_behind_the_lens_are_those_of_a_plain_sum():
    made = flat_lens(n=120)
    scan = psf.focus_scan(made)
    middle = (scan.x_um[1] - scan.x_um[0]) / 2  # slices lie half a sample off
    for i in (4, 13):
        moved = replace(made, sensor_distance_um=FOCAL + scan.shift_um[i])
        want = plain_irradiance(moved, scan.x_um[80:112:7], middle)
        # light beyond the window is not followed: 1e-3 of the peak
        got = scan.slices[i, 80:112:7]
        assert got == pytest.approx(want, abs=3e-3 * scan.peak[i])


def test_a_window_without_light_ends_1_and_says_where_the_rays_meet(saved, capsys):
    folder = saved(aside_um=48.0)
    assert run(folder, "--json", "--window-um", "40", "--angles-deg", "0") == 1
    said = printed(capsys)
    # rays are those of the nearest pillars, up to half a pitch of a radius of 33 um off
    assert said["rays_meet_um"] == pytest.approx([48.0, 0.0, FOCAL], rel=3e-3, abs=0.02)
    assert "(+48" in said["failures"][0]
    there = [
        "--window-um",
        "40",
        "--angles-deg",
        "0",
        "--offset-um",
        "48",
        "0",
        "--force",
    ]
    assert run(folder, "--json", *there) == 0
    focus = printed(capsys)["focus"][0]
    assert focus["window_share"] > 0.9
    assert focus["efficiency"] == pytest.approx(LEVEL**2 * 0.855, rel=0.03)


def test_design_psf_and_the_definition_agree_on_the_efficiency():
    """Power of a plain sum within three FWHM about the focus over the lens's area."""
    made = flat_lens(n=120)
    found = design.check_focus(made, axial=False).figures
    step = found.fwhm_um / 9
    axis = (np.arange(29) - 14) * step
    x, y = np.meshgrid(axis, axis)
    light = plain_irradiance(made, x, y)
    inside = np.hypot(x, y) <= 1.5 * found.fwhm_um
    power = light[inside].sum() * step**2
    area = PITCH**2 * np.count_nonzero(np.asarray(made.diameters.diameter_um))
    # cells that the rim cuts: 1 % of the light within
    assert found.efficiency == pytest.approx(power / area, rel=0.015)


def test_a_lens_of_a_tenth_of_a_fresnel_zone_has_its_figures_too():
    """20 um for 2 mm, R²/(wavelength d) = 0.06: its spot, 1.029 wavelength d / 2R, is
    four times as wide as the lens.
    """
    made = replace(flat_lens(n=54), sensor_distance_um=2000.0)
    found = design.check_focus(made, axial=False).figures
    assert found.fwhm_um == pytest.approx(1.029 * WAVE * 2000 / (54 * PITCH), rel=0.03)
    assert 0 < found.efficiency < LEVEL**2
