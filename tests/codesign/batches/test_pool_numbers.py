"""A pool of frames: what is kept of a rendering, and what is drawn from it, frame by
frame.
"""

import numpy as np
import pytest
import torch

from codesign.batches import EyeScenes, SceneConfig, pool
from codesign.batches.pool import FramePool, PoolScenes
from metalens.core.errors import TrainingError

COUNT = 7


def made():
    """Seven frames whose numbers tell their row: depths of 17 to 23 mm, the nominal
    place beside the axis.
    """
    rows = np.arange(COUNT)
    place = np.stack(
        [300.0 + 40 * rows, -700.0 + 90 * rows, 17_000.0 + 1_000 * rows], 1
    )
    seen = place + np.array([11.0, -23.0, 37.0])
    axis, points = (
        np.float32(0.1 * rows)[:, None] + np.ones((COUNT, 3), np.float32),
        np.ones((COUNT, 4, 2), np.float32),
    )
    light = np.full((COUNT, 6, 5), 10, np.uint8) + rows[:, None, None].astype(np.uint8)
    depth = np.full((COUNT, 6, 5), 20_000, np.uint16) + 100 * rows[
        :, None, None
    ].astype(np.uint16)
    mask = np.full((COUNT, 2, 2), 30, np.uint8) + 17 * rows[:, None, None].astype(
        np.uint8
    )
    return FramePool(light, depth, mask, place, seen, axis, points * rows[:, None, None].astype(np.float32),
                np.array([120.0, -340.0, 20_500.0]), np.array([15_000.0, 24_000.0]))  # fmt: skip


def test_a_frame_is_drawn_with_a_depth_of_its_own_and_all_that_is_true_of_it_moves_along():
    """The wanted depth over that of the place is the scale; slippage is the scaled
    place less the nominal one.
    """
    held = made()
    rows = np.array([1, 4, 6])
    got = PoolScenes(held, 2, 0.45, 9).rows(rows, np.random.default_rng(31))
    wanted = 15_000 + 9_000 * np.random.default_rng(31).random(3)
    scale = wanted / held.place_um[rows, 2]
    assert ((scale > 0.55) & (scale < 1.45)).all()  # no end of the reach
    assert got.frames.scale == pytest.approx(scale, rel=1e-6)  # float32
    slip = (
        scale[:, None] * held.place_um[rows] - np.array([120.0, -340.0, 20_500.0])
    ) / 1000
    shift = slip + scale[:, None] * np.array([11.0, -23.0, 37.0]) / 1000
    assert got.slip_mm.numpy() == pytest.approx(slip, abs=1e-6)
    assert got.pose.shift_mm.numpy() == pytest.approx(shift, abs=1e-6)
    assert got.mask[:, 1, 0].tolist() == pytest.approx([47 / 255, 98 / 255, 132 / 255])
    assert got.frames.light[:, 0, 3].tolist() == [11, 14, 16]
    assert got.frames.depth_um[:, 5, 0].tolist() == [20_100, 20_400, 20_600]
    assert got.pose.axis[:, 2].tolist() == pytest.approx([1.1, 1.4, 1.6])
    assert got.pose.points[:, 3, 1].tolist() == [1.0, 4.0, 6.0]
    assert {part.dtype for part in (got.slip_mm, got.pose.shift_mm, got.mask)} == {
        torch.float32
    }


def test_the_scale_reaches_no_farther_than_its_spread():
    got = PoolScenes(made(), 2, 0.02, 9).rows(
        np.arange(COUNT), np.random.default_rng(31)
    )
    wanted = (15_000 + 9_000 * np.random.default_rng(31).random(COUNT)) / (
        17_000 + 1_000 * np.arange(COUNT)
    )
    assert got.frames.scale == pytest.approx(np.clip(wanted, 0.98, 1.02), rel=1e-6)


def test_every_pass_has_an_order_of_its_own_in_which_no_frame_comes_twice():
    """Seven frames in batches of three: two steps a pass, one frame left out of each."""
    scenes = PoolScenes(made, 2, 0.2, 9)

    def drawn(step, size=3):
        return [int(v) - 10 for v in scenes.batch(step, size).frames.light[:, 0, 0]]

    for a_pass in range(3):
        order = np.random.default_rng([9, a_pass, 5]).permutation(COUNT)
        for k in range(2):
            assert drawn(2 * a_pass + k) == sorted(order[3 * k : 3 * k + 3])
    assert drawn(4, 7) == list(range(7))  # one step a pass
    want = scenes.rows(np.array(drawn(3)), np.random.default_rng([9, 3, 6]))
    assert torch.equal(scenes.batch(3, 3).slip_mm, want.slip_mm)
    with pytest.raises(
        TrainingError, match="a pool of 7 frames is smaller than a batch of 8"
    ):
        scenes.batch(0, 8)


@pytest.fixture(scope="module", params=[64, 128, 96])
def filled(request):
    """(scenes, pool) of five frames in parts of two, at scales of their own."""
    scenes = EyeScenes(
        SceneConfig(pixels=request.param, margin=8, scale=0.2),
        9.0 * 128 / request.param,
        2000.0,
        3,
        2,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "CHUNK", 2)
        return scenes, pool.render_pool(scenes, 5)


def test_a_pool_keeps_what_is_true_at_unit_scale_of_its_stream(filled):
    """Parts 0, 1 and 2 of the stream; places are the label and the nominal place, over
    the frame's scale.
    """
    scenes, held = filled
    assert len(held) == 5
    assert held.here_um.tolist() == [*scenes.rig.aim_um, scenes.rig.distance_um]
    assert held.depths_um.tolist() == list(scenes.depths_um)
    start = 0
    for number, count in enumerate((2, 2, 1)):
        frames, scale = (
            scenes.rendered(number, count),
            scenes.states(number, count).scale.numpy(),
        )
        rows = slice(start, start + count)
        for kept, label in (
            (held.place_um, frames.labels.slip_um),
            (held.seen_um, frames.labels.shift_um),
        ):
            assert kept[rows] * scale[:, None] - held.here_um == pytest.approx(
                label.numpy(), abs=1e-6
            )
        assert held.axis[rows] == pytest.approx(
            frames.labels.optic_axis.numpy(), abs=1e-6
        )
        size = scenes.settings.pixels
        middle = (frames.labels.pupil_px.numpy() - (size + 16 - 1) / 2) / size
        assert held.points[rows, -1] == pytest.approx(middle, abs=1e-6)
        light = frames.frames.radiance.sum(1).numpy()
        assert (
            np.abs(held.light[rows] / 255 - np.minimum(light, 1)).max()
            <= 0.5 / 255 + 1e-6
        )
        start += count


def test_masks_are_means_over_squares_on_a_grid_of_64_where_the_frame_allows_it(filled):
    scenes, held = filled
    size = scenes.settings.pixels
    inside = scenes.rendered(0, 2).pupil[:, 8:-8, 8:-8].numpy().astype(float)
    if size % 64 == 0:
        inside = inside.reshape(2, 64, size // 64, 64, size // 64).mean((2, 4))
    assert held.mask.shape[1:] == inside.shape[1:]
    assert np.abs(held.mask[:2] / 255 - inside).max() <= 0.5 / 255 + 1e-6
    assert inside.max() == pytest.approx(1.0, abs=1e-6)  # an eye that is seen


def test_a_kept_pool_is_read_as_it_was(tmp_path):
    held = made()
    pool.save_pool(tmp_path / "pool.h5", held)
    again = pool.load_pool(tmp_path / "pool.h5")
    for name in FramePool.__slots__:
        assert np.array_equal(getattr(again, name), getattr(held, name))
        assert getattr(again, name).dtype == getattr(held, name).dtype
