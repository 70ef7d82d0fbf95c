"""Frames blurred as if they stood elsewhere: depths in um, response per mm, of numbers
typed in.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.batches import Batch, Flat
from codesign.train import assess, depth_test
from metalens.image import Frames


def test_two_sheets_stand_farther_by_the_shift_and_nothing_else_changes():
    light, cover = torch.rand(2, 2, 3, 4), torch.rand(2, 2, 3, 4)
    frames = Frames(light, cover, torch.full((2, 2, 3, 4), 21_000.0))
    moved = depth_test.displaced(frames, -370.0)
    assert torch.equal(moved.depth_um, torch.full((2, 2, 3, 4), 20_630.0))
    assert moved.radiance is light
    assert moved.coverage is cover


def test_flat_frames_keep_their_scale_and_move_by_the_shift_in_their_own_depths():
    """A depth of 20 000 at unit scale stands at 25 000 in a frame of 1.25: 500 farther
    is 20 400; of 0.8 20 625. What
    is more than two bytes hold, or less than nothing, is held at their ends."""
    light = np.full((2, 1, 3), 70, np.uint8)
    depth = np.array([[[20_000, 65_400, 3]], [[20_000, 65_400, 3]]], np.uint16)
    moved = depth_test.displaced(
        Flat(light, depth, np.array([1.25, 0.8], np.float32)), 500.0
    )
    assert moved.depth_um.tolist() == [[[20_400, 65_535, 403]], [[20_625, 65_535, 628]]]
    assert moved.depth_um.dtype == np.uint16
    assert moved.scale.tolist() == pytest.approx([1.25, 0.8])
    assert (moved.light == 70).all()
    near = depth_test.displaced(
        Flat(light, depth, np.array([1.25, 0.8], np.float32)), -500.0
    )
    assert near.depth_um.tolist() == [[[19_600, 65_000, 0]], [[19_375, 64_775, 0]]]


class Scenes:
    """One batch a step, whose depth is its step's."""

    margin = 3

    def batch(self, step, size):
        frames = Frames(
            torch.ones(size, 2, 3, 4),
            torch.ones(size, 2, 3, 4),
            torch.full((size, 2, 3, 4), 900.0 * step),
        )
        return Batch(frames, torch.ones(size, 2, 2), torch.full((size, 3), 0.5))


def test_displaced_scenes_are_the_same_but_for_their_depth():
    plain = Scenes()
    moved = depth_test.Displaced(plain, 250.0)
    assert (moved.margin, moved.stream) == (3, 0)
    plain.stream = 17
    assert moved.stream == 17
    got, want = moved.batch(4, 5), plain.batch(4, 5)
    assert torch.equal(got.frames.depth_um, want.frames.depth_um + 250.0)
    assert torch.equal(got.slip_mm, want.slip_mm)
    assert len(got.mask) == 5


@pytest.mark.parametrize(("about", "shift_mm"), [({}, 1.0), ({"shift_um": 400.0}, 0.4)])
def test_a_response_is_of_the_axial_answer_per_mm_of_shift(
    monkeypatch, about, shift_mm
):
    """A reader that answers 0.7 mm for a mm of depth, 2 and 5 along the other axes, of
    four frames a batch.
    """
    asked = []

    def frames(trainer, scenes, batches):
        asked.append((trainer, batches))
        return [scenes.batch(k, 4).frames.depth_um[:, 0, 0, 0] for k in range(batches)]

    def predict(net, architecture, seen, inner):
        asked.append((net, architecture, inner))
        depth_mm = torch.cat(seen) * 1e-3
        return SimpleNamespace(
            slip_mm=torch.stack([2 * depth_mm, 5 * depth_mm, 0.7 * depth_mm], 1)
        )

    monkeypatch.setattr(assess, "frames", frames)
    monkeypatch.setattr(assess, "predict", predict)
    trainer = SimpleNamespace(inner="inner")
    made = depth_test.depth_response(
        trainer, Scenes(), "net", "member", batches=3, **about
    )
    assert made.mean == pytest.approx(
        0.7, rel=1e-5
    )  # float32 of 1 to 2 mm over the shift
    assert made.standard_error < 1e-5 / shift_mm
    assert made.frames == 12
    assert asked == [(trainer, 3), ("net", "member", "inner")] * 2
