"""What is told of imaged frames, from PSFs and frames that are typed in: which axis is
which, what depths are asked.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.evaluate import imaged
from codesign.eye import CameraRig, PinholeCamera

KNOWN = SimpleNamespace(wavelengths_um=(0.85, 0.85))
LENS = SimpleNamespace(reduced_um=310.0, sensor_distance_um=340.0, proxy=KNOWN)


class Optics:
    """An imager with 4 rows, 5 columns and 3 depths of nodes; it doubles the light and
    moves it by a column.
    """

    stack = torch.arange(4 * 5 * 3 * 2 * 2, dtype=torch.float64).reshape(4, 5, 3, 2, 2)
    plan = SimpleNamespace(
        y_um=torch.tensor([-90.0, -20.0, 30.0, 70.0]),
        x_um=torch.tensor([-120.0, -60.0, 5.0, 50.0, 110.0]),
        depths_um=torch.tensor([20e3, 30e3, 45e3]),
    )
    error, parts = 0.02, {"field": 0.01}

    def above(self, tolerance):
        return f"{self.error} and {tolerance}"

    def __call__(self, frames):
        return 2 * frames.light.roll(1, -1)


def test_rows_columns_and_depths_keep_their_places(monkeypatch):
    """First, middle and last of each; angles over the reduced distance; depths of what
    is covered, 2 % beyond.
    """
    asked = {}
    monkeypatch.setattr(
        imaged,
        "lens_imager",
        lambda lens, camera, reach, **more: asked.update(reach=reach) or Optics(),
    )
    light = torch.rand(
        (2, 8, 8), generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    depth = torch.full((2, 2, 3, 3), 31e3)
    depth[0, 0, 0, 0], depth[1, 1, 2, 1], depth[1, 0, 1, 1] = 24e3, 41e3, 1.0
    frames = SimpleNamespace(depth_um=depth, coverage=(depth > 2).double(), light=light)
    whole = torch.nn.functional.pad(
        light, (48, 48, 48, 48), value=7.0
    )  # 144 um about the frame

    def rendered(camera, rig):
        asked.update(pixels=camera.pixels, distance=rig.sensor_distance_um)
        return SimpleNamespace(frames=frames, pinhole=lambda: whole)

    found = imaged.image_first_frames(
        LENS, PinholeCamera(8, 3.0), CameraRig(), rendered
    )
    assert found.problem == "0.02 and 0.03"
    assert asked["reach"] == pytest.approx((0.98 * 24e3, 1.02 * 41e3))
    assert (asked["pixels"], asked["distance"]) == (8 + 2 * 48, 310.0)
    assert found.scene == pytest.approx(light.numpy(), rel=1e-6)
    assert found.image == pytest.approx(
        light.roll(1, -1).numpy(), rel=1e-6
    )  # scaled to the light of the scene
    assert found.y_deg == pytest.approx(
        [math.degrees(math.atan(v / 310)) for v in (-90, 30, 70)]
    )
    assert found.x_deg == pytest.approx(
        [math.degrees(math.atan(v / 310)) for v in (-120, 5, 110)]
    )
    assert found.depth_um.tolist() == [20e3, 30e3, 45e3]
    want = np.moveaxis(Optics.stack.numpy()[[0, 2, 3]][:, [0, 2, 4]], 2, 0)
    assert np.array_equal(found.psf, want)
