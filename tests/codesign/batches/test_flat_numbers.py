"""Flat frames by hand: bytes of light and depth, and images of two kernels that are
single bright pixels.
"""

import numpy as np
import pytest
import torch

from codesign.batches import flat
from codesign.batches.flat import SingleSurfaceFrames, flatten_layers
from metalens.image import Frames, PsfBasis, uniform_imager

DEPTHS_UM = np.array([10_000.0, 16_000.0, 40_000.0])
WEIGHTS = np.array(
    [[1.0, 0.2], [0.5, -0.3], [0.1, 0.8]]
)  # of the two kernels at these depths
STEPS = ((0, 0), (-2, 3))  # down and right by which the kernels move light
MARGIN = 2


def sheets(scale):
    """Two frames of 2 x 3 samples: light, cover and depth of the near and the far
    sheet.
    """
    near = torch.tensor([[[0.1, 0.3, 0.7], [0.0, 0.2, 0.002]]] * 2)
    far = torch.tensor([[[0.4, 0.6, 0.8], [0.0, 0.1, 0.001]]] * 2)
    cover = torch.tensor([[[0.9, 0.5, 0.4], [0.0, 0.51, 0.49]]] * 2)
    depth = torch.tensor(
        [[[21_000.0, 22_000.0, 23_000.0], [70_000.0, 24_000.4, -5.0]]] * 2
    )
    frames = Frames(
        torch.stack([near, far], 1),
        torch.stack([cover, 1 - cover], 1),
        torch.stack([depth, depth + 700.0], 1),
    )
    return frames, torch.tensor(scale)


def test_light_adds_up_to_255_and_the_depth_is_of_the_sheet_that_covers_more():
    """0.5 is 127.5, rounded up; 0.003 is 0.77; 1.5 is cut. Far where it covers more
    than a half: 60 % and 51 %, not at
    a half; depths over the scale of 1.25 and 0.8."""
    frames, scale = sheets([1.25, 0.8])
    made = flatten_layers(frames, scale)
    assert made.light.tolist() == [[[128, 230, 255], [0, 77, 1]]] * 2
    assert made.depth_um[0].tolist() == [
        [16_800, 17_600, 18_960],
        [56_560, 19_200, 556],
    ]
    assert made.depth_um[1].tolist() == [
        [26_250, 27_500, 29_625],
        [65_535, 30_000, 869],
    ]
    assert made.scale.tolist() == pytest.approx([1.25, 0.8])
    assert (made.light.dtype, made.depth_um.dtype, made.scale.dtype) == (
        np.uint8,
        np.uint16,
        np.float32,
    )
    assert flat.frame_samples(made) == flat.frame_samples(frames) == 3


def test_depths_come_back_with_their_scale_and_without_the_margin():
    """Also those above 32 767 of two bytes; nothing stands nearer than 1 um."""
    frames, _ = sheets([1.25, 0.8])
    kept = SingleSurfaceFrames(
        np.zeros((2, 5, 5), np.uint8),
        np.arange(50, dtype=np.uint16).reshape(2, 5, 5) * 1_300,
        np.array([1.25, 0.8]),
    )
    whole = flat.depth_um(kept)
    assert whole[1, 4, 3].item() == pytest.approx(48 * 1_300 * 0.8, rel=1e-6)
    assert whole[0, 0, 0].item() == 1.0
    assert torch.equal(flat.depth_um(kept, margin=2), whole[:, 2:3, 2:3])
    square = Frames(
        *(
            torch.nn.functional.pad(part, (1, 1, 1, 2))
            for part in (frames.radiance, frames.coverage, frames.depth_um)
        )
    )
    inner = flat.depth_um(square, margin=1)
    assert inner[0].flatten().tolist() == pytest.approx(
        [21_000, 22_000, 23_700, 70_700, 24_000.4, 695, 1, 1, 1], rel=1e-6
    )


def imager(rows, columns):
    """Single bright pixels of a kernel of 7 x 7, moved by STEPS."""
    kernels = torch.zeros(2, 7, 7)
    for k, (down, right) in enumerate(STEPS):
        kernels[k, 3 + down, 3 + right] = 1.0
    psf = PsfBasis(
        kernels,
        torch.tensor(WEIGHTS[None, None], dtype=torch.float32),
        torch.tensor(DEPTHS_UM),
        0.0,
        0.0,
    )
    return uniform_imager(psf, (rows, columns), margin=MARGIN)


def expected(frames):
    """Every pixel's light times the weights of its depth, straight in 1/z, moved by the
    steps of each kernel; the
    border goes on beyond the frame."""
    depth = np.maximum(frames.depth_um, 1.0) * frames.scale[:, None, None]
    out = 0.0
    for k, (down, right) in enumerate(STEPS):
        share = np.interp(-1 / depth, -1 / DEPTHS_UM, WEIGHTS[:, k])
        wide = np.pad(share * frames.light / 255, ((0, 0), (3, 3), (3, 3)), mode="edge")
        rows, columns = frames.light.shape[1:]
        out = out + wide[:, 3 - down : 3 - down + rows, 3 - right : 3 - right + columns]
    return out[:, MARGIN:-MARGIN, MARGIN:-MARGIN]


@pytest.mark.parametrize(("rows", "columns"), [(9, 12), (13, 8)])
def test_images_are_what_every_pixel_sends_by_its_depth(rows, columns):
    """Five frames of unlike scales, from before the nearest depth to behind the
    farthest, and 0. Half a code of 4095
    over 7.5e-5 of 1/um moves a weight by 2e-4 at most."""
    draw = np.random.default_rng(5)
    light = draw.integers(0, 256, (5, rows, columns)).astype(np.uint8)
    depth = draw.integers(7_000, 60_000, (5, rows, columns)).astype(np.uint16)
    depth[:, 4, 5] = 0
    frames, optics = (
        SingleSurfaceFrames(light, depth, np.array([0.83, 1.0, 1.21, 0.9, 1.1])),
        imager(rows, columns),
    )
    want = expected(frames)
    ways = [
        flat.sensor_irradiance,
        *([flat._elsewhere] if columns >= rows else []),
    ]  # on a device frames are not tall
    for got in (way(frames, optics, margin=MARGIN) for way in ways):
        assert got.shape == want.shape
        assert got.numpy() == pytest.approx(want, abs=5e-4)


def test_weights_at_the_depths_of_the_stack_are_its_own():
    """At the nodes no code lies between: 10 and 40 mm to single precision; the one
    between to half a code.
    """
    depth = np.array(DEPTHS_UM, np.uint16)[None, None].repeat(7, 1).repeat(3, 2)
    frames, optics = (
        SingleSurfaceFrames(np.full((1, 7, 9), 200, np.uint8), depth, np.ones(1)),
        imager(7, 9),
    )
    want = expected(frames)
    got = flat.sensor_irradiance(frames, optics, margin=MARGIN).numpy()
    assert got == pytest.approx(want, abs=3e-4)
    table = flat._table(optics)
    assert table.shape == (4096, 2)
    assert table[[0, -1]] == pytest.approx(WEIGHTS[[0, -1]], rel=1e-6)
    middle = 2 / (
        1 / DEPTHS_UM[0] + 1 / DEPTHS_UM[-1]
    )  # half-way in 1/z: 16 mm, the second depth
    assert middle == pytest.approx(16_000.0)
    assert table[2048] == pytest.approx(WEIGHTS[1], abs=3e-4)


def test_two_sheets_go_their_own_way():
    """Frames of two sheets are imaged as scenes are: opaque, evenly lit ones stay what
    they are but for the weights.
    """
    frames = Frames(*(torch.full((1, 2, 11, 11), v) for v in (0.0, 0.0, 20_000.0)))
    frames.radiance[:, 1], frames.coverage[:, 1] = 0.6, 1.0
    got = flat.sensor_irradiance(frames, imager(11, 11), margin=MARGIN)
    assert got.shape == (1, 7, 7)
    assert got.numpy() == pytest.approx(0.6, abs=1e-5)


def test_frames_that_are_wider_than_high_lose_their_margin_on_every_side():
    """Nine columns of five rows: one row and five columns are left of a margin of two."""
    kept = SingleSurfaceFrames(
        np.zeros((1, 5, 9), np.uint8),
        np.arange(45, dtype=np.uint16).reshape(1, 5, 9) + 7,
        np.ones(1),
    )
    assert flat.depth_um(kept, margin=2).tolist() == [[[27.0, 28.0, 29.0, 30.0, 31.0]]]
