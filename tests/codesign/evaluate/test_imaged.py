"""Rendered eyes through a lens: the same eyes, the same light, and PSFs at the angles
of the sensor's rim.
"""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.commands import view
from codesign.evaluate import scene_image
from codesign.eye import CameraRig, PinholeCamera, population, render
from metalens import design, lens
from metalens.cell import Film, Index
from metalens.core.errors import SceneError
from metalens.core.store import Provenance
from metalens.design import Focus
from metalens.optics import Layers
from tests.codesign import made_lens as m
from tests.command_line import call

CAMERA = PinholeCamera(20, 4.8)
RIG = replace(CameraRig(), elevation_rad=0.6)
LENS = design.make(
    design.phase_of(None, Focus(0.85, 900.0, 9e3), radius_um=75.0),
    Focus(0.85, 900.0, 9e3),
    aperture_um=150.0,
    cell=m.CELL,
    proxy=m.PROXY,
)[0]


@pytest.fixture(scope="module")
def found():
    states = population.states_at(torch.arange(2), 5)
    return scene_image.image_first_frames(
        LENS, CAMERA, RIG, lambda camera, rig: render(states, rig=rig, camera=camera)
    )


def test_the_scene_is_what_a_pinhole_at_the_lens_sees(found):
    """Without the margin that is blurred in: the rays of a camera of that size alone."""
    rig = replace(RIG, sensor_distance_um=LENS.sensor_distance_um)
    plain = (
        render(population.states_at(torch.arange(2), 5), rig=rig, camera=CAMERA)
        .pinhole()
        .numpy()
    )
    # samples of wider frames have the same rays; a tenth of a per cent of them lie on
    # edges that round otherwise
    assert np.mean(np.abs(found.scene - plain) > 1e-4) < 2e-3


def test_the_image_has_the_light_of_the_scene_and_less_of_its_detail(found):
    assert found.image.sum() == pytest.approx(float(found.scene.sum()), rel=1e-5)
    step = [
        float(np.abs(np.diff(one, axis=-1)).mean())
        for one in (found.scene, found.image)
    ]
    assert step[1] < 0.8 * step[0]
    assert 0 < found.error < 0.3


def test_behind_films_samples_show_the_directions_of_the_reduced_distance():
    """180 um of index 1.5 in the 900 um to the sensor: 840 um of air; scene and field
    angles alike.
    """
    behind = replace(LENS, layers=Layers(behind=(Film(Index(1.5), 180.0),)))
    states, seen = population.states_at(torch.arange(1), 5), []

    def rendered(camera, rig):
        seen.append(rig.sensor_distance_um)
        return render(states, rig=rig, camera=camera)

    made = scene_image.image_first_frames(behind, PinholeCamera(16, 8.0), RIG, rendered)
    assert seen == [pytest.approx(840.0)]
    beside = 18  # samples of 8 um: half a window of 288 um
    rim = math.degrees(math.atan((16 + 2 * beside - 1) / 2 * 8.0 / 840.0))
    assert made.x_deg.tolist() == pytest.approx([-rim, 0, rim], abs=1e-9)
    assert made.y_deg.tolist() == pytest.approx([-rim, 0, rim], abs=1e-9)
    assert made.psf.shape[3:] == (37, 37)


def test_what_is_written_is_what_is_shown(found, tmp_path):
    scene_image.write_images(tmp_path, found, Provenance())
    both, apart, points = view.image_panels(tmp_path / "image.h5")
    assert np.array_equal(both.values[1, 0], found.scene[1])
    assert np.array_equal(both.values[1, 1], found.image[1])
    assert np.array_equal(apart.values, found.image - found.scene)
    assert points.axes[2].values == pytest.approx(found.x_deg.tolist())
    assert f"{found.error:.2g}" in both.caption
    assert (tmp_path / "image.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_images_through_a_lens_file(tmp_path, capsys):
    lens.save(tmp_path / "lens.h5", LENS)
    (tmp_path / "scene.toml").write_text("frames = 1\npixels = 16\npitch_um = 8.0\n")
    words = f"scene {tmp_path}/scene.toml -o {tmp_path}/out"
    assert call(f"{words} --fwhm-nm 20") == 2
    assert "need 0 or more, and --lens" in capsys.readouterr().err
    assert call(f"{words} --lens {tmp_path}/lens.h5 --quiet") == 0
    assert {"image.h5", "image.png", "scene.h5"} <= {
        path.name for path in (tmp_path / "out").iterdir()
    }


def test_light_that_the_pillars_are_not_known_for_is_told_and_no_error():
    """A diode of 20 nm, pillars known to 9.5 nm below its middle and 12 nm above: two
    tails of a normal distribution,
    in points 0.25 nm apart, of which silicon weighs the blue by 4 % more. The image's
    wavelengths lie within."""
    known = replace(LENS, proxy=replace(m.PROXY, wavelengths_um=(0.8405, 0.862)))
    deviation = 20.0 / math.sqrt(8 * math.log(2))
    tails = sum(math.erfc(away / deviation / math.sqrt(2)) / 2 for away in (9.5, 12))
    states = population.states_at(torch.arange(1), 5)
    made = scene_image.image_first_frames(
        known,
        PinholeCamera(16, 9.0),
        RIG,
        lambda c, rig: render(states, rig=rig, camera=c),
        fwhm_nm=20.0,
    )
    share = re.match(r"; (\S+) of the light lies beyond 840.5 to 862 nm", made.light)
    assert float(share[1]) == pytest.approx(tails, rel=0.05)
    assert made.error < tails / 3


def test_an_image_above_its_aim_ends_1_and_says_what_does_it(tmp_path, capsys):
    """A lens of 4 um at 300 um: its rim bends a tenth of the light further than the
    windows reach.
    """
    focus = Focus(0.85, 300.0, 3000.0)
    phase = design.phase_of(None, focus, radius_um=2.0)
    tiny, _ = design.make(phase, focus, aperture_um=4.0, cell=m.CELL, proxy=m.PROXY)
    lens.save(tmp_path / "lens.h5", tiny)
    (tmp_path / "scene.toml").write_text("frames = 1\npixels = 16\npitch_um = 9.0\n")
    words = f"scene {tmp_path}/scene.toml -o {tmp_path}/out"
    assert call(f"{words} --lens {tmp_path}/lens.h5") == 1
    told = capsys.readouterr().out
    assert "is above the 0.03 asked for (" in told
    assert (tmp_path / "out" / "image.h5").is_file()


def test_a_frame_that_sees_behind_the_lens_is_refused_with_its_angle():
    """12 samples of 9 um and 16 at each side: 198 um from the axis, 77 degrees at 46
    um, past the face's edge.
    """
    near = replace(LENS, sensor_distance_um=46.0)
    states = population.states_at(torch.arange(1), 0)
    with pytest.raises(
        SceneError, match="reaches to 77 degrees through a lens 46 um before its sensor"
    ):
        scene_image.image_first_frames(
            near,
            PinholeCamera(12, 9.0),
            CameraRig(),
            lambda camera, rig: render(states, rig=rig, camera=camera),
        )
