"""Registration of shifted images and calibration of a camera on drawn boards, both with
known truth.
"""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from characterize.measure import register
from metalens.ground.errors import CaptureError


def scene(dx, dy, seed):
    y, x = np.mgrid[:64, :64]
    light = np.zeros((64, 64))
    for cx, cy, s, a in ((30, 28, 3, 900), (40, 36, 2, 500), (22, 40, 4, 400)):
        light += a * np.exp(-((x - cx - dx) ** 2 + (y - cy - dy) ** 2) / (2 * s**2))
    return np.random.default_rng(seed).poisson(light + 20).astype(float)


@pytest.mark.parametrize(("dx", "dy"), [(0.37, -0.81), (5.2, 3.6), (-9.4, 2.5)])
def test_shift_to_a_twentieth_of_a_pixel(dx, dy):
    found = register.shift(scene(dx, dy, 1), scene(0, 0, 2))
    assert abs(found.x_px - dx) < 0.05
    assert abs(found.y_px - dy) < 0.05
    assert found.likeness > 0.98


def test_images_of_other_shape_are_refused():
    with pytest.raises(CaptureError, match="crop them alike"):
        register.shift(np.zeros((5, 5)), np.zeros((6, 5)))


def test_camera_is_calibrated_on_drawn_boards():
    about = dict(squares=(8, 6), square_um=5000.0, marker_um=3700.0)
    picture = register.board(**about).generateImage((1600, 1200))
    matrix = np.array([[900.0, 0, 320], [0, 900.0, 240], [0, 0, 1]])
    views = []
    for tilt, turn, far in (
        (0.0, 0.0, 70e3),
        (0.4, 0.1, 75e3),
        (-0.4, 0.2, 72e3),
        (0.1, 0.45, 78e3),
        (-0.2, -0.4, 74e3),
        (0.3, -0.3, 70e3),
    ):
        rotation = cv2.Rodrigues(np.array([tilt, turn, 0.05]))[0]
        to_um = np.array([[40e3 / 1600, 0, -20e3], [0, 30e3 / 1200, -15e3], [0, 0, 1]])
        place = np.column_stack([rotation[:, :2], [0, 0, far]])
        views.append(
            cv2.warpPerspective(
                picture,
                matrix @ place @ to_um,
                (640, 480),
                borderValue=255,
                flags=cv2.INTER_AREA,
            )
        )
    found = register.calibrate(
        [ndimage.gaussian_filter(v, 0.7) for v in views], **about
    )
    assert found.views == 6
    assert found.rms_px < 0.5
    assert abs(found.matrix[0, 0] - 900) < 15
    ax, ay = found.angle_rad(320 + 90, 240)
    assert abs(ax - np.arctan(0.1)) < 3e-3
    assert abs(ay) < 6e-3
    with pytest.raises(CaptureError, match="four or more"):
        register.calibrate([np.zeros((100, 100), np.uint8)] * 4, **about)
