"""metalens psf: file, pictures, exit codes, and the way from pillars through the proxy."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from metalens import lens, propagate, psf
from metalens.cell.record import Cell
from metalens.cli import main
from metalens.pillars.proxy import Proxy

SETTINGS = """
depths_mm = [0.8, 2.0, 0.4]
angles_deg = [0.0, 15.0]
window_um = 16.0
samples = 24
"""


def small_lens(n=64):
    x = (np.arange(n) - (n - 1) / 2) * 0.4
    r2 = x**2 + x[:, None] ** 2
    phase = -2 * np.pi / 0.85 * (r2 / (np.sqrt(r2 + 120.0**2) + 120) + r2 / (np.sqrt(r2 + 1300.0**2) + 1300))
    diameter = np.where(r2 < x[-1] ** 2, 0.1 + 0.2 * np.mod(phase, 2 * np.pi) / (2 * np.pi), 0)
    proxy = Proxy(np.array([[np.pi, np.pi]]), np.array([[0.9, 0.0]]), (0.1, 0.3), (0.85, 0.85), 0.0, 0.0)
    return lens.Lens(lens.DiameterMap(diameter, 0.4), Cell(pitch_um=0.4), proxy, 0.85, 120.0, 1300.0, "hyperbolic")


@pytest.fixture
def folder(tmp_path):
    lens.save(tmp_path / "lens.h5", small_lens())
    (tmp_path / "psf.toml").write_text(SETTINGS)
    return tmp_path


def command(folder, *more):
    return main(
        ["psf", str(folder / "lens.h5"), "-o", str(folder / "psf.h5"), "--config", str(folder / "psf.toml"), *more]
    )


def test_command_writes_stack_pictures_and_report(folder, capsys):
    assert command(folder, "--json", "--report") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["converged"]
    assert said["error"] <= 1e-4
    for name in ("xz", "montage", "mtf", "information"):
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


def test_the_budget_takes_the_terms_of_the_lens_s_own_cell_where_asked(folder, monkeypatch):
    """Rows and tilted pillars are solved at its own aperture and the largest angle; without them it says rough."""
    asked = []

    def rows(_, *, counts):
        asked.append(counts)
        return SimpleNamespace(a=0.0, b=0.0)

    monkeypatch.setattr("metalens.design.own_cell.neighbours", rows)
    monkeypatch.setattr("metalens.design.own_cell.angle_change", lambda _, tilt: 0.03 * np.sin(tilt))
    assert command(folder, "--quiet") == 0
    rough = psf.load(folder / "psf.h5")
    (folder / "psf.toml").write_text(SETTINGS + "own_cell = true\n")
    assert command(folder, "--quiet", "--force") == 0
    own = psf.load(folder / "psf.h5")
    assert asked == [(12, 8)]  # NA 0.11: 19 pillars in a zone, more than a row takes
    assert rough.budget.neighbours > 0
    assert own.budget.neighbours == pytest.approx(0.0, abs=1e-12)
    assert own.budget.angle == pytest.approx(0.03 * np.sin(np.deg2rad(15.0)))
    assert "rough" in rough.reason
    assert "own cell" in own.reason


def test_nothing_is_overwritten_without_force(folder):
    assert command(folder, "--quiet") == 0
    assert command(folder, "--quiet") == 2
    assert command(folder, "--quiet", "--force", "--tolerance", "1e-5") == 0
    assert psf.load(folder / "psf.h5").tolerance == 1e-5


@pytest.mark.parametrize(
    "text",
    ["depths_mm = [2.0, 1.0, 0.5]", "angles_deg = []", "toleranc = 1e-3", "tolerance = 0.0", "angles_deg = [95.0]"],
)
def test_bad_settings_exit_2_and_write_nothing(folder, text, capsys):
    (folder / "psf.toml").write_text(text)
    assert command(folder) == 2
    assert not (folder / "psf.h5").exists()
    assert "metalens: error" in capsys.readouterr().err


def test_a_proxy_outside_its_wavelengths_exits_2(folder):
    (folder / "psf.toml").write_text(SETTINGS + "led_fwhm_nm = 30.0\n")
    assert command(folder) == 2


def test_a_tolerance_out_of_reach_exits_1(folder):
    assert command(folder, "--quiet", "--tolerance", "1e-13") == 1
