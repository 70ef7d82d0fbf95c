"""What frames wear, on frames made by hand: factors, bands, movements in closed form;
none at variety 1; seeded.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.batches.scenes import EyeScenes, SceneConfig
from codesign.batches.surface_frames import flatten_layers
from codesign.eye import appearance as wear
from codesign.eye import renderer
from codesign.eye.renderer import FrameLabels, RenderedFrames
from metalens.image import Frames

N = 64
SCENES = EyeScenes(SceneConfig(pixels=48, margin=4, variety=2.0), 24.0, 2000.0, 5)


def scene(skin=0.5, eye=0.3, opening=(20, 40), left=30):
    """One frame: the eye in the rows of ``opening``, a pupil of 8 x 10 pixels in it,
    skin 4 mm before it.
    """
    cover = torch.zeros(1, 2, N, N)
    cover[:, 1, opening[0] : opening[1]] = 1
    cover[:, 0] = 1 - cover[:, 1]
    light = cover * torch.tensor([skin, eye])[None, :, None, None]
    depth = torch.full((1, 2, N, N), 20e3)
    depth[:, 0] = 16e3
    pupil = torch.zeros(1, N, N)
    pupil[:, 26:34, left : left + 10] = 1
    one = torch.zeros(1, dtype=torch.float64)
    three = torch.zeros(1, 3, dtype=torch.float64)
    place = torch.tensor([[34.5, 29.5]], dtype=torch.float64)
    labels = FrameLabels(
        three, three, three, three, three, three, place, one + 0.9, torch.zeros(1, 9, 2)
    )
    return RenderedFrames(Frames(light, cover, depth), pupil, labels)


def put_on(made, draws=None, **size):
    """The frame with some causes of these sizes, placed by ``draws``."""
    all_of = {name: np.zeros(1) for name in wear.CAUSES} | {
        name: np.array([v]) for name, v in size.items()
    }
    placed = np.full((1, 12), 0.3) if draws is None else np.array([draws])
    return wear.apply_augmentations(
        made, {name: np.column_stack([size, placed]) for name, size in all_of.items()}
    )


def test_light_that_falls_off_is_a_plane_through_1_in_the_middle():
    draws = np.full(12, 0.3)
    out = put_on(scene(), gradient=0.4)
    line = (torch.arange(N) + 0.5) / N - 0.5
    angle = 6.283 * draws[7]
    plane = 1 + 0.8 * (line[None] * math.cos(angle) + line[:, None] * math.sin(angle))
    torch.testing.assert_close(
        out.pinhole()[0], scene().pinhole()[0] * plane, rtol=1e-5, atol=1e-6
    )
    assert torch.equal(out.pupil, scene().pupil)


def test_a_shadow_takes_its_share_far_inside_and_nothing_far_outside():
    draws = np.full(12, 0.0)
    # edge along x, 6 % below the middle, 2 % wide
    draws[8], draws[9], draws[10] = (0.25, 0.0, 0.6)
    out = put_on(scene(), draws, shade=0.6)
    ratio = (out.pinhole() / scene().pinhole())[0]
    assert ratio[-1].tolist() == pytest.approx([0.4] * N, abs=1e-4)
    assert ratio[0].tolist() == pytest.approx([1.0] * N, abs=1e-4)
    assert 0.5 < float(ratio[round((0.5 + 0.06) * N), 5]) < 0.9


def test_a_liner_darkens_the_skin_beside_the_opening_alone():
    draws = np.zeros(12)
    draws[0], draws[1] = 0.9, 0.9  # 0.0375 of 64 pixels: 2 rows above, 1 below
    out = put_on(scene(), draws, liner=0.7)
    rows = out.pinhole()[0, :, 11]
    want = torch.full((N,), 0.5)
    want[20:40], want[18:20], want[40] = 0.3, 0.15, 0.15
    torch.testing.assert_close(rows, want, rtol=1e-6, atol=1e-7)


def test_glints_lie_on_the_eye_at_their_distance_from_the_pupil():
    draws = np.zeros(12)
    draws[3], draws[4], draws[6] = 0.0, 0.5, 0.9  # to +x, 5.5 % of the frame away
    added = (put_on(scene(), draws, glints=0.8).pinhole() - scene().pinhole())[0]
    peak = np.unravel_index(int(added.argmax()), added.shape)
    assert peak[1] == pytest.approx(34.5 + 0.055 * N, abs=1.0)
    assert peak[0] == pytest.approx(29.5, abs=1.0)
    assert 0.5 < float(added.max()) <= 0.8
    assert float(added[:20].abs().max()) == 0


def test_a_rim_hides_what_is_behind_it_and_stands_nearer():
    draws = np.full(12, 0.3)
    # a wide circle whose right side is 0.351 frames right of the middle
    draws[6], draws[7] = (1.0, 0.0)
    before = scene(left=50)
    out = put_on(before, draws, rim=0.08)
    cover = out.frames.coverage[0]
    torch.testing.assert_close(cover.sum(0), torch.ones(N, N), rtol=0, atol=1e-5)
    # centres in 54.46 … 59.58
    assert torch.nonzero(cover[1, 31] < 0.5)[:, 0].tolist() == [54, 55, 56, 57, 58, 59]
    hidden = (cover[1] < 0.5) & (before.frames.coverage[0, 1] > 0.5)
    assert out.frames.depth_um[0, 0][hidden].unique().tolist() == [14e3]  # 0.7 of 20 mm
    assert float((out.pupil[0] - before.pupil[0] * cover[1]).abs().max()) < 1e-5
    share = float(out.pupil.sum() / before.pupil.sum())
    assert 0.4 < share < 0.6  # columns 54 (half hidden) to 59 of 50 to 59
    assert float(out.labels.visible) == pytest.approx(0.9 * share, rel=1e-5)
    columns = out.pupil[0].sum(0)
    assert 49.5 < float((columns * torch.arange(N)).sum() / columns.sum()) < 54.5 - 1


def test_dressed_frames_have_a_depth_wherever_they_are_seen():
    made = SCENES.rendered(4, 8)  # a rim is among them
    flat = flatten_layers(made.frames, torch.ones(8))
    # the nearest skin that the rig can see, at the widest slip and tilt, is at 6 mm
    assert flat.depth_um.min() > 4000


def test_mirrored_windows_add_light_and_hide_nothing():
    out = put_on(scene(), reflection=0.6)
    added = (out.pinhole() - scene().pinhole())[0]
    assert float(added.min()) >= 0
    assert 0.55 < float(added.max()) < 1.5
    assert torch.equal(out.frames.coverage, scene().frames.coverage)
    assert torch.equal(out.pupil, scene().pupil)


@pytest.mark.parametrize(("length", "angle"), [(6.0, 0.0), (9.0, 0.7), (7.5, 2.2)])
def test_a_movement_spreads_by_its_length_along_its_way(length, angle):
    """A line of length L has the variance L² / 12; bilinear taps add t (1 - t) <= 1/4
    an axis.
    """
    kernel = wear.line_kernel(length, angle).double().numpy()
    place = np.arange(len(kernel)) - len(kernel) // 2
    x, y = np.meshgrid(place, place)
    assert kernel.sum() == pytest.approx(1, abs=1e-6)
    assert (kernel * x).sum() == pytest.approx(0, abs=1e-6)
    assert (kernel * y).sum() == pytest.approx(0, abs=1e-6)
    along = x * math.cos(angle) + y * math.sin(angle)
    across = y * math.cos(angle) - x * math.sin(angle)
    # 32 places of the line: 0.1 % less
    assert -0.01 <= (kernel * along**2).sum() - length**2 / 12 <= 0.25
    assert 0 <= (kernel * across**2).sum() <= 0.25


def test_a_moved_mask_keeps_its_area_and_centre_and_depths_stay():
    out = put_on(scene(), movement=0.1)
    assert float(out.pupil.sum()) == pytest.approx(80.0, rel=1e-4)
    centre = [
        float((out.pupil[0].sum(k) * torch.arange(N)).sum() / out.pupil.sum())
        for k in (0, 1)
    ]
    assert centre == pytest.approx([34.5, 29.5], abs=1e-3)
    assert 0.1 < float(out.pupil[0, 26, 30]) < 0.9  # a corner of the pupil is smeared
    assert float((out.frames.depth_um - scene().frames.depth_um).abs().max()) < 0.1
    assert float(wear.line_kernel(0.0, 0.4)[0, 0]) == 1


def test_nothing_is_worn_up_to_variety_1_and_the_share_of_the_record_at_2():
    off = wear.draw_augmentations(2000, 1.0, np.random.default_rng(0))
    assert not any(values[:, 0].any() for values in off.values())
    on = wear.draw_augmentations(2000, 2.0, np.random.default_rng(0))
    for name, cause in wear.CAUSES.items():
        size = on[name][:, 0]
        size = size[size != 0]
        assert len(size) / 2000 == pytest.approx(
            cause.share, abs=4 * math.sqrt(0.25 / 2000)
        )
        assert cause.low <= size.min() < size.max() <= cause.high
        assert cause.unit
        assert cause.what
    more = wear.draw_augmentations(2000, 3.0, np.random.default_rng(0))
    assert all(
        np.array_equal(more[name][values[:, 0] != 0, 0], values[values[:, 0] != 0, 0])
        for name, values in on.items()
    )


def test_scenes_wear_by_their_variety_and_from_their_seed():
    bare = replace(SCENES, settings=replace(SCENES.settings, variety=1.0))
    plain = renderer.render(bare.states(2, 6), rig=bare.rig, camera=bare.camera)
    assert torch.equal(bare.rendered(2, 6).pinhole(), plain.pinhole())
    one, again = SCENES.rendered(2, 6), SCENES.rendered(2, 6)
    assert torch.equal(one.pinhole(), again.pinhole())
    torch.testing.assert_close(
        SCENES.batch(2, 6).slip_mm.double() * 1e3,
        one.labels.slip_um,
        rtol=1e-6,
        atol=1e-3,
    )
    assert float((one.frames.coverage.sum(1) - 1).abs().max()) < 1e-4
    undressed = renderer.render(
        SCENES.states(2, 6), rig=SCENES.rig, camera=SCENES.camera
    )
    assert not torch.equal(one.pinhole(), undressed.pinhole())
