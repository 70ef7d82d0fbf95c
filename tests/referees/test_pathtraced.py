"""The path-traced referee: shapes where the renderer sees them, light of known amount,
refusals without Mitsuba.
"""

import sys

import numpy as np
import pytest
import torch

from codesign.eye import model, renderer
from codesign.eye import population as eye
from codesign.eye.population import CameraRig
from codesign.eye.renderer import PinholeCamera
from metalens.core.errors import SceneError
from tests.codesign.eye import plain_eye
from tests.referees import pathtraced, traced_shapes
from tests.referees.pathtraced import Comparison

CAMERA = PinholeCamera(pixels=32, pitch_um=45.0)
STATES = eye.draw_states(2, 5)


def test_without_mitsuba_the_referee_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(
        SceneError, match=r"pip install 'metalens-toolchain\[referee\]'"
    ):
        pathtraced.start()
    with pytest.raises(SceneError, match="2 or more"):
        pathtraced.compare(STATES, samples=1)


def test_noise_of_the_halves_does_not_count_as_error():
    """Two noisy copies of the truth: the error of the truth is 0 on average, that of 10
    % more is 10 %.
    """
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 0.8, (200, 200))
    halves = truth * (1 + 0.5 * rng.standard_normal((2, 200, 200)))
    every = {"all": np.ones(truth.shape, bool)}
    made = Comparison(truth, halves, every, (0.0, 0.0), 2, "none")
    assert made.error() < 0.06  # fourth root of 40 000 pixels: 0.5 / 14
    assert made.error(image=1.1 * truth) == pytest.approx(0.1, abs=0.02)
    assert made.ratio() == pytest.approx(1, abs=0.01)


def test_shapes_lie_on_the_surfaces_that_rays_meet():
    """Points of the meshes against the closed forms of sphere, plane and limbus, and
    against the renderer's depth.
    """
    p = pathtraced._parameters(STATES, CameraRig(), CAMERA)
    bank = pathtraced._bank()
    centre, axis = p[:3].numpy(), p[model.AXIS : model.AXIS + 3].numpy()
    globe, _, white = traced_shapes._globe(p, bank)
    assert np.ptp(np.linalg.norm(1e3 * globe - centre, axis=1)) < 1e-6
    assert float((1e3 * globe - centre).dot(axis).max()) == pytest.approx(
        float(p[model.LIMBUS_D]), rel=1e-9
    )
    assert 0 < white.min() < white.max() < 1
    iris, _, brown = traced_shapes._iris(p, bank)
    height = (1e3 * iris - centre).dot(axis).reshape(-1, 513)
    np.testing.assert_allclose(height[2:-1], float(p[model.PUPIL_D]), atol=1e-6)
    assert brown.min() > 0
    face, triangles, _ = traced_shapes._face(p, bank, CameraRig(), CAMERA)
    depth = renderer.render(STATES[:1], camera=CAMERA).frames.depth_um[0, 0]
    assert 1e3 * face[:, 2].min() < float(
        depth.min()
    )  # the mesh is wider than the frame
    assert triangles.max() < len(face)


def test_regions_do_not_overlap_and_cover_the_frame():
    masks = pathtraced._regions(STATES[:1], CameraRig(), CAMERA)
    assert (sum(masks[name].astype(int) for name in pathtraced.REGIONS) == 1).all()
    np.testing.assert_array_equal(masks["all"], ~masks["mirrors"])


def test_skin_and_iris_are_as_bright_as_traced_ones(tmp_path):
    """No factor is fitted: albedos and lamps are the model's. Left are shadows and
    light between surfaces.
    """
    pytest.importorskip("mitsuba")
    made = pathtraced.compare(STATES, camera=CAMERA, samples=256)
    assert made.ratio("skin") == pytest.approx(1, abs=0.1)
    assert made.ratio("iris") == pytest.approx(
        1, abs=0.2
    )  # noise of few paths through the cornea: 3 %
    assert made.error() < 0.3
    dark = made.regions["pupil"]
    assert made.traced[dark].mean() < 0.3 * made.traced[made.regions["iris"]].mean()
    pathtraced.picture(made, tmp_path / "beside.png")
    assert (tmp_path / "beside.png").stat().st_size > 1000
    assert made.lines()[1].startswith("all")


def test_a_mirrored_scene_would_be_noticed():
    """Against the frame flipped left to right the error is far larger: axes agree
    between both programs.
    """
    pytest.importorskip("mitsuba")
    made = pathtraced.compare(STATES, camera=CAMERA, samples=64)
    assert made.error() < 0.7 * min(
        made.error(image=made.ours[:, ::-1]), made.error(image=made.ours[::-1])
    )


def test_ambient_light_on_white_skin_is_the_models():
    """Integral of the sky over the hemisphere of a normal: ambient (0.6 - 0.4 n.down),
    whatever the normal.
    """
    p = pathtraced._parameters(STATES, CameraRig(), CAMERA)
    rng = np.random.default_rng(0)
    way = rng.standard_normal((200_000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    down = p[model.FACE_Y : model.FACE_Y + 3].numpy()
    sky = traced_shapes._sky(p, -way @ down)
    for normal in (down, -down, np.array([0.0, 0.6, -0.8])):
        cosine = (way @ normal).clip(0)
        got = (sky * cosine).mean() * 4  # radiance of a white surface: irradiance / pi
        want = plain_eye.ambient(p, *torch.from_numpy(normal))
        assert got == pytest.approx(float(want), rel=0.02)  # 200 000 directions
