"""metalens psf: file, pictures, exit codes, and the way from pillars through the proxy."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, special

from metalens import lens, propagate, psf
from metalens.cell.record import Cell
from metalens.commands.psf import Options, PsfSettings
from metalens.core.errors import ConfigError
from metalens.lens import NeighbourRows
from metalens.psf import lens_psfs
from tests.command_line import call
from tests.proxies import proxy_of

SETTINGS = """
depths_mm = [0.8, 2.0, 0.4]
angles_deg = [0.0, 15.0]
window_um = 16.0
samples = 24
"""


def small_lens(n=64):
    x = (np.arange(n) - (n - 1) / 2) * 0.4
    r2 = x**2 + x[:, None] ** 2
    phase = (
        -2
        * np.pi
        / 0.85
        * (r2 / (np.sqrt(r2 + 120.0**2) + 120) + r2 / (np.sqrt(r2 + 1300.0**2) + 1300))
    )
    diameter = np.where(
        r2 < x[-1] ** 2, 0.1 + 0.2 * np.mod(phase, 2 * np.pi) / (2 * np.pi), 0
    )
    proxy = proxy_of([np.pi, np.pi], [0.9, 0.0], (0.1, 0.3), 0.85)
    return lens.Lens(
        lens.DiameterMap(diameter, 0.4),
        Cell(pitch_um=0.4),
        proxy,
        0.85,
        120.0,
        1300.0,
        "hyperbolic",
    )


@pytest.fixture
def folder(tmp_path):
    lens.save(tmp_path / "lens.h5", small_lens())
    (tmp_path / "psf.toml").write_text(SETTINGS)
    return tmp_path


def command(folder, *more):
    return call(
        f"psf {folder}/lens.h5 -o {folder}/psf.h5 --config {folder}/psf.toml", *more
    )


def test_command_writes_stack_pictures_and_report(folder, capsys):
    assert command(folder, "--json", "--report") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["converged"]
    assert said["error"] <= 1e-4
    for name in ("xz", "montage", "mtf"):
        assert (folder / f"psf_{name}.png").read_bytes()[:4] == b"\x89PNG"
    assert "Point spread functions" in (folder / "psf.html").read_text()
    stack = psf.load(folder / "psf.h5")
    assert stack.intensity.shape == (2, 4, 24, 24)
    assert "lens.h5" in stack.provenance.inputs
    made = small_lens()
    power = np.abs(
        propagate.exact(
            made.phase_rad(),
            made.transmission(),
            pitch_um=0.4,
            wavelength_um=0.85,
            sensor_distance_um=120.0,
            depths_um=stack.depths_um,
            angle_rad=np.deg2rad(15.0),
            window_um=16.0,
            samples=24,
        )
    )
    want = power**2 / (power**2).sum((1, 2), keepdims=True)
    assert np.linalg.norm(stack.intensity[1] - want) < 1e-4 * np.linalg.norm(want)


def test_the_budget_takes_the_terms_of_the_lens_s_own_cell_where_asked(
    folder, monkeypatch
):
    """Rows are solved at its own aperture; without them it says rough.

    A fifth of what the rows change is left: here they leave 0.81 of the light where it
    is turned by 0.2, in the PSFs
    too. What they take meets the focus again, spread over the lens's shadow: ‖2 Re U*
    n‖² = 2 P ∫|U|² / area, with the
    Airy disc of a lens of this aperture."""
    asked = []

    factor = np.full((2, 2), 0.9 + 0j)
    known = NeighbourRows(
        np.array([0.4, 0.2]), np.zeros(2, bool), factor, factor, np.zeros(2), 0.85
    )

    def rows(_, *, counts):
        asked.append(counts)
        return known

    monkeypatch.setattr("metalens.design.own_cell.estimate_neighbour_coupling", rows)
    assert command(folder, "--quiet") == 0
    rough = psf.load(folder / "psf.h5")
    (folder / "psf.toml").write_text(SETTINGS + "own_cell = true\n")
    assert command(folder, "--quiet", "--force") == 0
    own = psf.load(folder / "psf.h5")
    assert asked == [(6, 9, 12)]  # NA 0.11: 19 pillars in a zone, more than a row takes
    assert rough.budget.neighbours > 0
    made = small_lens()
    edge = lens_psfs.sine_aperture(made, (0.0, 0.0))
    kept = integrate.quad(
        lambda s: float(abs(known.mean(np.array(s))) ** 2) * 2 * s / edge**2, 0, edge
    )[0]
    airy = (
        integrate.quad(lambda x: (2 * special.j1(x) / x) ** 4 * x, 1e-9, 60, limit=200)[
            0
        ]
        / 2**2
    )
    wide_um2 = 2 * np.pi * (0.85 / (2 * np.pi * edge)) ** 2 / airy
    scattered = math.sqrt(
        2
        * (1 - kept)
        / kept
        * wide_um2
        / (made.diameters.pillars * made.cell.pitch_um**2)
    )
    # 2 %: the cone of 15 degrees is a little narrower, and 1 / (1 - s²) is left out
    # here
    assert 0.98 * scattered < own.budget.neighbours < math.hypot(1.02 * scattered, 0.05)
    assert (own.energy_um2 < 0.99 * rough.energy_um2).all()
    assert "rough" in rough.reason
    assert "unlike neighbours counted, by 2 solved rows" in own.reason


@pytest.mark.parametrize(
    "text",
    [
        "depths_mm = [2.0, 1.0, 0.5]",
        "angles_deg = []",
        "toleranc = 1e-3",
        "tolerance = 0.0",
        "angles_deg = [95.0]",
    ],
)
def test_bad_settings_exit_2_and_write_nothing(folder, text, capsys):
    (folder / "psf.toml").write_text(text)
    assert command(folder) == 2
    assert not (folder / "psf.h5").exists()
    assert "metalens: error" in capsys.readouterr().err


def test_a_tolerance_out_of_reach_exits_1(folder):
    assert command(folder, "--quiet", "--tolerance", "1e-13") == 1


def test_plane_waves_windows_and_lines_from_the_command_line(folder, capsys):
    """Options stand in place of the file; the same case by the library has the same
    numbers.
    """
    more = "--sources-mm inf 1.4 --angles-deg -12 --angles-y-deg 7 --window-um 12 --samples 20 --height-um 7.2"
    more += " --offset-um 1.5 -0.8 --wavelengths-nm 850"
    assert command(folder, "--json", *more.split()) == 0
    said = json.loads(
        capsys.readouterr().out,
        parse_constant=lambda word: pytest.fail(f"{word} is no JSON"),
    )
    assert said["depths_um"] == [None, 1400.0]
    stack = psf.load(folder / "psf.h5")
    assert stack.intensity.shape == (1, 2, 12, 20)
    assert np.isinf(stack.depths_um[0])
    distance = 120.0
    assert stack.centres_um[0] == pytest.approx(
        [
            distance * np.tan(np.deg2rad(-12)) + 1.5,
            distance * np.tan(np.deg2rad(7)) - 0.8,
        ]
    )
    made = small_lens()
    power = np.abs(
        propagate.exact(
            made.phase_rad(), made.transmission(), pitch_um=0.4, wavelength_um=0.85, sensor_distance_um=distance,
            depths_um=stack.depths_um, angle_rad=np.deg2rad([-12.0, 7.0]), window_um=(12.0, 7.2), samples=(20, 12),
            offset_um=(1.5, -0.8),
        )
    )  # fmt: skip
    want = power**2 / (power**2).sum((1, 2), keepdims=True)
    assert np.linalg.norm(stack.intensity[0] - want) < 1e-4 * np.linalg.norm(want)
    assert call(f"info {folder}/psf.h5") == 0
    assert call(f"view {folder}/psf.h5 -o {folder}/page.html --quiet") == 0


def test_a_finite_source_from_the_command_line(folder):
    """Half a degree about a direction; the error of taking the PSF as alike is in the
    file.
    """
    more = (
        "--angles-deg",
        "4",
        "--source-deg",
        "2",
        "--source-shape",
        "square",
        "--tolerance",
        "0.05",
        "--quiet",
    )
    assert command(folder, *more) == 0
    stack = psf.load(folder / "psf.h5")
    assert 0 < stack.budget.source < 0.05
    size = 2 * np.tan(np.deg2rad(1))
    view = psf.View(
        tuple(stack.depths_um),
        ((np.deg2rad(4.0), 0.0),),
        16.0,
        24,
        source=psf.SourceExtent("square", 0.0, size),
    )
    assert psf.from_lens(small_lens(), view, tolerance=0.05).intensity == pytest.approx(
        stack.intensity, abs=1e-9
    )


@pytest.mark.parametrize(
    "more",
    [
        ("--source-um", "10", "--sources-mm", "inf"),
        ("--source-um", "10", "--source-deg", "1"),
        ("--height-um", "7"),
        ("--wavelengths-nm", "850", "--led-fwhm-nm", "10"),
        ("--wavelengths-nm", "850", "--weights", "1", "2"),
        ("--sources-mm", "0"),
        ("--wavelengths-nm", "700"),
    ],
)
def test_options_that_contradict_exit_2_and_write_nothing(folder, more, capsys):
    assert command(folder, *more) == 2
    said = capsys.readouterr().err
    assert "metalens: error" in said
    assert (
        any(name.strip("-").replace("-", "_") in said for name in more)
        or "wavelength" in said
    )
    assert not (folder / "psf.h5").exists()


def test_depths_and_window_that_are_left_out_follow_the_lens():
    """Rim 12.6 um: 1.75 waves at |1/z - 1/1.3 mm| = 2 x 1.75 x 0.85 / 12.6²; 28
    wavelength / NA of 120 um.
    """
    made = small_lens()
    settings = PsfSettings(angles_deg=(0.0,)).about(made)
    rim = made.diameters.radius_um
    most = 2 * 1.75 * 0.85 / rim**2
    near, far = settings.sources_mm[0], settings.sources_mm[-1]
    assert near == pytest.approx(1e-3 / (1 / 1300 + most), rel=0.05)  # two digits
    assert far == pytest.approx(10 * near, rel=0.05)
    assert len(settings.view.depths_um) == 21
    blur = rim * 120 * (1 / (near * 1e3) - 1 / 1300)
    assert settings.window_um == pytest.approx(
        max(28 * 0.85 * 120 / rim, 8 * blur), rel=5e-3
    )
    near_only = PsfSettings(sources_mm=(0.05, 2.0)).about(made)
    assert near_only.window_um == pytest.approx(
        8 * rim * 120 * (1 / 50 - 1 / 1300), rel=5e-3
    )
    assert PsfSettings(window_um=9.0, depths_mm=(1.0, 2.0, 0.5)).about(
        made
    ).view.window_um == (9.0, 9.0)


def test_settings_that_wait_for_a_lens_say_so():
    with pytest.raises(ConfigError, match="depths_mm"):
        _ = PsfSettings(window_um=10.0).view
    with pytest.raises(ConfigError, match="window_um"):
        _ = PsfSettings(depths_mm=(1.0, 2.0, 1.0), angles_deg=(0.0,)).view
    with pytest.raises(ConfigError, match="need window_um"):
        PsfSettings(height_um=10.0)


def test_every_setting_but_two_is_an_option():
    """As the page on lenses says; the light of two sizes was one of the file alone,
    where refusals name the option.
    """
    names = {one.name for one in fields(PsfSettings)} - {"layers", "own_cell"}
    assert names <= {one.name for one in fields(Options)}
    assert Options(Path("lens.h5"), light="y").settings.light == "y"


def test_light_along_x_is_refused_of_round_pillars(folder, capsys):
    assert command(folder, "--light", "x") == 2
    assert (
        "light = 'x' is for pillars of two sizes; these treat x and y alike"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(("bars", "code"), [(0.09, 0), (0.11, 1)])
def test_psfs_of_hardly_known_pillars_end_1_with_the_word_that_design_gives(
    folder, bars, code, capsys
):
    """Error bars above 0.1 of |t|, the largest tolerance of a library."""
    made = small_lens()
    lens.save(
        folder / "lens.h5", replace(made, proxy=replace(made.proxy, entry_error=bars))
    )
    assert command(folder) == code
    assert (
        "FAILED: the pillars' own error bars are 0.11 of |t|" in capsys.readouterr().out
    ) == bool(code)
    assert (folder / "psf.h5").exists()


def test_a_source_too_wide_for_the_tolerance_is_told_with_its_own_cure(folder, capsys):
    """30 um at 2 mm are 0.86 deg: the PSF of this lens at 15 deg changes over them by
    more than 1e-6.
    """
    assert command(folder, "--source-um", "30", "--tolerance", "1e-6") == 1
    told = capsys.readouterr().out
    assert "is above the tolerance 1e-06: raise it or give a smaller source" in told
    assert "widen" not in told


def test_source_filter_and_sensor_are_the_product_of_their_curves(folder, capsys):
    # triangle from 838 to 862 nm, band from 844 to 862, ramp 850 + 2 (nm - 850): with
    # u = (nm - 850) / 12 the weight is (1 - |u|) (850 + 24 u) for -1/2 < u < 1
    wide = replace(
        small_lens(), proxy=proxy_of([np.pi] * 2, [0.9, 0.0], (0.1, 0.3), (0.8, 0.9))
    )
    lens.save(folder / "wide.h5", wide)
    (folder / "led.csv").write_text("wavelength (µm);p\n0,838;0\n0,85;4\n0,862;0\n")
    (folder / "band.csv").write_text("# nm, T\n843.9999,0\n844,0.5\n870,0.5\n")
    (folder / "qe.csv").write_text("nm\tqe\n800\t750\n900\t950\n")
    files = {"source": "led.csv", "filter": "band.csv", "sensor": "qe.csv"}
    keys = [word for key in files for word in (f"--{key}", folder / files[key])]
    (folder / "s.toml").write_text(
        "".join(f"{key} = '{folder / file}'\n" for key, file in files.items())
    )
    shown = ["--sources-mm", 1.3, "--angles-deg", 0, "--window-um", 16, "--samples", 24]
    want = [
        integrate.quad(
            lambda u, n=n: (850 + 12 * u) ** n * (1 - abs(u)) * (850 + 24 * u),
            -0.5,
            1,
            points=[0],
        )[0]
        for n in range(3)
    ]
    mean_nm = want[1] / want[0]
    options = ["psf", folder / "wide.h5", *shown, "--tolerance", 1e-3, "--json"]
    for form in (
        [*keys, "-o", folder / "a.h5"],
        ["--config", folder / "s.toml", "-o", folder / "b.h5"],
    ):
        assert call(*options, *form) == 0
        stack = psf.load(form[-1])
        nm = stack.wavelengths_um * 1e3
        assert stack.weights @ nm == pytest.approx(mean_nm, abs=1e-3)
        assert stack.weights @ (nm - mean_nm) ** 2 == pytest.approx(
            want[2] / want[0] - mean_nm**2, rel=1e-3
        )
    refused = ["psf", folder / "lens.h5", *shown, *keys, "-o", folder / "c.h5"]
    assert call(*refused) == 2
    assert "pillars are known at 850 nm alone" in capsys.readouterr().err
    assert call(*options, "--source", "LED-B1", "-o", folder / "c.h5") == 2
    assert "known from 800 to 900 nm" in capsys.readouterr().err
    assert call(*options, "--source", "LED-B11", "-o", folder / "c.h5") == 2
    assert "'LED-B1'" in capsys.readouterr().err
    (folder / "bad.csv").write_text("840,1\n850,x\n")
    for name, named in (("bad.csv", "line 2"), ("none.csv", "cannot be read")):
        assert call(*options, "--sensor", folder / name, "-o", folder / "c.h5") == 2
        assert named in capsys.readouterr().err
    assert not (folder / "c.h5").exists()
