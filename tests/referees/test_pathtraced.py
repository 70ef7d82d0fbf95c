"""The path-traced referee: shapes where the renderer sees them, light of known amount,
refusals without Mitsuba.
"""

import numpy as np
import pytest

from codesign.eye import population as eye
from codesign.eye import renderer
from codesign.eye.population import CameraRig
from codesign.eye.renderer import PinholeCamera
from tests.codesign.eye import model
from tests.referees import pathtraced, traced_shapes

CAMERA = PinholeCamera(pixels=32, pitch_um=45.0)
STATES = eye.draw_states(2, 5)


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
    # the mesh is wider than the frame
    assert 1e3 * face[:, 2].min() < float(depth.min())
    assert triangles.max() < len(face)


def test_skin_and_iris_are_as_bright_as_traced_ones(tmp_path):
    """No factor is fitted: albedos and lamps are the model's. Left are shadows and
    light between surfaces.
    """
    pytest.importorskip("mitsuba")
    made = pathtraced.compare(STATES, camera=CAMERA, samples=256)
    assert made.ratio("skin") == pytest.approx(1, abs=0.1)
    # noise of few paths through the cornea: 3 %
    assert made.ratio("iris") == pytest.approx(1, abs=0.2)
    assert made.error() < 0.3
    dark = made.regions["pupil"]
    assert made.traced[dark].mean() < 0.3 * made.traced[made.regions["iris"]].mean()
    pathtraced.picture(made, tmp_path / "beside.png")
    assert (tmp_path / "beside.png").stat().st_size > 1000
    assert made.lines()[1].startswith("all")
