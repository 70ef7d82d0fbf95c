"""From a lens file to captures, and from captures to the as-built lens, on the command
line.
"""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

import characterize
from characterize.inference import AsBuilt
from metalens import lens as lenses
from metalens import psf
from metalens.core import store
from metalens.fabrication import solved_rates
from tests.command_line import call

TRUTH = """
depths_um = [400.0, 600.0, 1000.0]
peak_e = 5000.0
seed = 3
dark_frames = 4
flat_frames = 8
[camera]
pixel_um = 1.5
pixels = 16
[[parameter]]
name = "bias_nm"
value = 3.0
[[parameter]]
name = "crosstalk_px"
value = 0.2
[[parameter]]
name = "background_e"
value = 15.0
"""


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Slopes of the pillars, of bench and fit alike, at few harmonics: a small part of
    the time.
    """
    monkeypatch.setattr(solved_rates, "_TRUNCATIONS", (2, 3))
    cache = tmp_path.with_name(f"{tmp_path.name}_cache")
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    lenses.save(tmp_path / "lens.h5", b.lens())
    (tmp_path / "truth.toml").write_text(TRUTH)
    return tmp_path


def shoot(bench, *more):
    return call(
        f"capture {bench}/lens.h5 --truth {bench}/truth.toml -o {bench}/shots", *more
    )


def test_capture_then_fit(bench, capsys, fine_pictures):
    assert shoot(bench, "--quiet") == 0
    shots = characterize.load(bench / "shots")
    assert shots.frames.shape == (3, 16, 16)
    assert shots.position_um.tolist() == [400, 600, 1000]
    first = store.sha256(bench / "shots" / "frame_000.tif")
    assert shoot(bench) == 2  # exists
    assert shoot(bench, "--force", "--quiet") == 0
    assert store.sha256(bench / "shots" / "frame_000.tif") == first
    (bench / "told.toml").write_text(
        'scan_um = 60.0\n[[known]]\nname = "height_nm"\nvalue = 0.0\nsigma = 2.0\n'
    )
    capsys.readouterr()
    words = f"fit {bench}/shots --design {bench}/lens.h5 --metrology {bench}/told.toml"
    words += f" --truth {bench}/truth.toml"
    words += f" -o {bench}/as.h5 --next-mask --json"
    assert call(words) == 1  # three depths leave the height and the side wall open
    found = json.loads(capsys.readouterr().out)
    assert "posterior leaves the bias table open" in found["failures"][0]
    assert not (bench / "as_bias.toml").exists()
    value, sigma = found["parameters"]["bias_nm"]
    assert abs(value - 3.0) < 4 * sigma
    assert AsBuilt.load(bench / "as.h5").trusted
    assert (bench / "as.html").stat().st_size > 20000
    assert (bench / "as_posterior.png").stat().st_size > 10000
    page = (bench / "as.html").read_text(encoding="utf-8")
    assert "the hidden truth" in page
    the_psfs_are_those_of_the_made_lens(bench)
    for shown, title in (("shots", "Frames"), ("as.h5", "Captured less fitted")):
        assert call(f"view {bench}/{shown} -o {bench}/page.html --force --quiet") == 0
        assert f'"title": "{title}"' in (bench / "page.html").read_text(
            encoding="utf-8"
        )


def the_psfs_are_those_of_the_made_lens(bench):
    """``metalens psf`` of an as-built file: the record's own PSFs, and not those of the
    design.
    """
    (bench / "psf.toml").write_text(
        "depths_mm = [0.5, 0.7, 0.2]\nangles_deg = [0.0]\nwindow_um = 24.0\nsamples = 32\ntolerance = 1e-3\n"
    )
    for source in ("as", "lens"):
        words = f"psf {bench}/{source}.h5 --config {bench}/psf.toml --quiet"
        assert call(f"{words} -o {bench}/{source}_psf.h5") == 0
    built, design = (
        psf.load(bench / f"{name}_psf.h5").intensity for name in ("as", "lens")
    )
    want = (
        AsBuilt.load(bench / "as.h5")
        .psf_stack(psf.View((500.0, 700.0), ((0.0, 0.0),), 24.0, 32), tolerance=1e-3)
        .intensity
    )
    assert abs(built - want).max() < 1e-9 * want.max()  # rounding
    assert abs(design / design.max() - want / want.max()).max() > 0.02


def test_bad_words_end_with_2_and_leave_nothing(bench):
    assert call(f"fit {bench}/none --design {bench}/lens.h5 -o {bench}/a.h5") == 2
    assert call(f"fit {bench}/none -o {bench}/a.h5") == 2
    (bench / "truth.toml").write_text(TRUTH.replace("bias_nm", "bais_nm"))
    assert shoot(bench) == 2
    assert sorted(p.name for p in bench.iterdir()) == ["lens.h5", "truth.toml"]
