"""``metalens scene`` from a config to files; bad configs are refused and leave nothing."""

import math

import cv2
import numpy as np
import pytest

from metalens import lens, psf
from metalens.core import store
from tests.codesign.evaluate.test_imaged import LENS
from tests.command_line import call

TOML = "frames = 6\npixels = 64\npitch_um = 22.5\nseed = 4\nscale = 0.1\n"


def test_scene_writes_sheet_and_labels(tmp_path):
    source = tmp_path / "scene.toml"
    source.write_text(TOML)
    assert call(f"scene {source} -o {tmp_path}/out --quiet") == 0
    sheet = cv2.imread(str(tmp_path / "out" / "sheet.png"), cv2.IMREAD_GRAYSCALE)
    assert sheet.shape == (3 * 64, 6 * 64)
    assert sheet[:64].std() > 20
    lines = (tmp_path / "out" / "labels.csv").read_text().splitlines()
    assert len(lines) == 7
    assert len(lines[0].split(",")) == len(lines[1].split(","))
    assert store.load(tmp_path / "out" / "scene.h5", "scene").provenance.seed == 4


def test_variety_changes_the_frames_and_is_reproducible(tmp_path):
    sheets = []
    for name, variety in (("bare", 1.0), ("worn", 2.5), ("again", 2.5)):
        (tmp_path / "scene.toml").write_text(TOML + f"variety = {variety}\n")
        assert call(f"scene {tmp_path}/scene.toml -o {tmp_path}/{name} --quiet") == 0
        sheets.append((tmp_path / name / "sheet.png").read_bytes())
    assert sheets[0] != sheets[1] == sheets[2]


def test_bad_scene_is_refused_with_the_key(tmp_path, capsys):
    source = tmp_path / "scene.toml"
    source.write_text("distance_mm = 0.0\n")
    assert call(f"scene {source} -o {tmp_path}/out") == 2
    assert "distance_mm" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    source.write_text("variety = 5.0\n")
    assert call(f"scene {source} -o {tmp_path}/out") == 2
    assert "variety = 5.0: need 0 to 4" in capsys.readouterr().err


def _imaged(tmp_path, pixels, *more):
    lens.save(tmp_path / "lens.h5", LENS)
    cv2.imwrite(str(tmp_path / "photo.png"), pixels)
    words = ["scene", "--image", tmp_path / "photo.png", "--depth-mm", 7.5, *more]
    assert call(*words, tmp_path / "lens.h5", "-o", tmp_path / "out") == 0
    stored = store.load(tmp_path / "out" / "image.h5", "image")
    sensor = cv2.imread(str(tmp_path / "out" / "sensor.png"), cv2.IMREAD_UNCHANGED)
    return stored.arrays["image"], stored.attributes, sensor


def test_a_bright_pixel_of_a_picture_is_imaged_as_the_psf_of_its_place(tmp_path):
    pixels = np.zeros((61, 81), np.uint8)
    pixels[40, 22] = 255
    image, about, sensor = _imaged(tmp_path, pixels, "--width-mm", 2.5)
    # 2.5 mm at 7.5 mm, on a sensor at the lens's distance behind it
    step_um = 2.5 / 7.5 * LENS.sensor_distance_um / 81
    assert about["pitch_um"] == pytest.approx(step_um, rel=1e-12)
    x, y = -18 * step_um, 10 * step_um
    angle = (
        math.atan(x / LENS.sensor_distance_um),
        math.atan(y / LENS.sensor_distance_um),
    )
    square = psf.SourceExtent("square", 2500 / 81, 0.0)
    view = psf.View((7500.0,), (angle,), (25 * step_um,) * 2, (25, 25), (0, 0), square)
    stack = psf.from_lens(LENS, view, tolerance=1e-4)
    aperture_um2 = (LENS.diameters.diameter_um > 0).sum() * LENS.diameters.pitch_um**2
    falloff = (1 + (x**2 + y**2) / LENS.sensor_distance_um**2) ** -2
    want = stack.intensity[0, 0] * stack.energy_um2[0, 0] / aperture_um2 * falloff
    error = np.abs(image[0, 28:53, 10:35] - want).max() / want.max()
    assert error < about["error"] + stack.error
    peak = np.unravel_index(sensor.argmax(), sensor.shape)
    assert (peak, sensor.max()) == ((40, 22), 65535)


def test_an_even_picture_stays_even_in_every_colour(tmp_path):
    """But for cos^4 of the field angle, 2.4 degrees in the corner: 0.35 %."""
    bgr = np.full((13, 17, 3), (200, 64, 128), np.uint8)
    image, about, sensor = _imaged(tmp_path, bgr, "--width-mm", 0.5, "--fwhm-nm", 0)
    assert np.ptp(image, axis=(1, 2)) / image.mean((1, 2)) == pytest.approx(
        0, abs=0.0085
    )
    assert image.mean((1, 2)) / image.mean() * (128 + 64 + 200) / 3 == pytest.approx(
        [128, 64, 200], rel=1e-4
    )
    assert sensor[6, 8] / sensor.max() * 200 == pytest.approx([200, 64, 128], rel=5e-3)
    assert about["error"] < 0.03


def test_a_picture_without_depth_or_lens_is_refused(tmp_path, capsys):
    (tmp_path / "photo.png").write_bytes(b"no picture")
    lens.save(tmp_path / "lens.h5", LENS)
    words = ["scene", "--image", tmp_path / "photo.png", "-o", tmp_path / "out"]
    for more, named in (
        ([tmp_path / "lens.h5"], "--depth-mm"),
        (["--depth-mm", 9], "lens.h5"),
        (["--depth-mm", 9, tmp_path / "lens.h5"], "no picture"),
    ):
        assert call(*words, *more) == 2
        assert named in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
