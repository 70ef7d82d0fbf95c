"""Pixels that do not divide the image: the last reach beyond it, and a network tells
places in the frame it sees.
"""

from dataclasses import replace

import pytest
import torch

from codesign.network import losses, smallest_architecture
from codesign.train import assess, inner, run
from codesign.train.formation import frame_wide, read_out
from metalens.image import Sensor

SAMPLES, SAMPLE_UM, PITCH_UM = (
    96,
    3.0,
    13.0,
)  # 22.15 pixels: 23, of which the last reach 5.5 um beyond on every side
RUN = """
preset = "smoke"
validation_batches = 1
test_batches = 1
[scenes]
pixels = 48
margin = 4
[inner]
steps = 1
batch = 2
[optics]
image = "uniform"
aperture_mm = 0.3
sensor_distance_mm = 1.0
depth_count = 4
window_samples = 9
[run]
budgets_mmacs = [2.0]
pitch_um = 19.1
frozen = ["pitch"]
"""


def _square(low, high):
    """Light of a square of samples near the lower right corner: rows from low, columns
    from low + 5.
    """
    image = torch.zeros(1, SAMPLES, SAMPLES)
    image[:, low:high, low + 5 : high] = 1
    return image


def _middle(image):
    """(y, x) centroid as a fraction of the width from the middle."""
    place = (torch.arange(image.shape[-1]) + 0.5) / image.shape[-1] - 0.5
    return torch.tensor(
        [(image.sum(1 - k) * place).sum() / image.sum() for k in (0, 1)]
    )


def test_a_mask_of_the_image_lies_where_the_pixels_show_it():
    """The frame is 23 · 13 / 288 as wide as the image; the mask taken for one of the
    frame is 0.3 pixels off here.
    """
    wide = frame_wide(SAMPLES, SAMPLE_UM, PITCH_UM)
    assert wide == pytest.approx(23 * 13.0 / 288, rel=1e-12)
    light = _square(74, 94)
    sensor = Sensor(PITCH_UM, PITCH_UM, 4000.0, 0.0, 1e6, 0.0, 16)
    pitch = torch.tensor(PITCH_UM, dtype=torch.float64)
    seen = read_out(light, SAMPLE_UM, pitch, sensor, generator=None, quiet=True)[0, 0]
    shown = _middle(seen - seen.min())
    framed = _middle(losses.mask_in_frame(light, wide)[0])
    assert (
        float((framed - shown).abs().max()) * 23 < 0.03
    )  # pixels: the cubic overshoots at edges, which is cut off
    assert float((_middle(light[0]) - shown).abs().max()) * 23 > 0.3
    assert losses.mask_in_frame(light, 1.0) is light
    assert float(losses.mask_in_frame(light, wide).sum()) * wide**2 == pytest.approx(
        float(light.sum()), rel=1e-5
    )


def test_pixels_that_divide_the_image_see_all_of_it_and_no_more():
    """Whatever the rounding of the lengths."""
    assert [
        frame_wide(n, s, p)
        for n, s, p in ((96, 3.0, 12.0), (156, 12.0, 12.0), (49, 0.7, 4.9))
    ] == [1.0] * 3
    assert frame_wide(10, 1.0, 25.0) == 2.5  # one pixel, larger than the image


def test_training_and_scores_hold_networks_to_the_frame(tmp_path, monkeypatch):
    """45.2 pixels of an image: mask and landmarks of the frame train and score, the
    pupil's place is the image's.
    """
    (tmp_path / "run.toml").write_text(RUN)
    settings = run.load_run_settings(tmp_path / "run.toml")
    going = run.start_run(replace(settings, scenes=replace(settings.scenes, pool=0)))
    trainer, wide = going.trainer, 46 * 19.1 / (48 * 18.0)
    batch, told = trainer.scenes.batch(0, 2), []
    task, pose = losses.task_loss, losses.pose_loss

    def task_of(answer, mask, *others, **weights):
        told.append(mask)
        return task(answer, mask, *others, **weights)

    def pose_of(answer, axis, points, **weights):
        told.append(points)
        return pose(answer, axis, points, **weights)

    monkeypatch.setattr(inner.losses, "task_loss", task_of)
    monkeypatch.setattr(inner.losses, "pose_loss", pose_of)
    list(trainer.run())
    assert torch.equal(told[0], losses.mask_in_frame(batch.mask, wide))
    torch.testing.assert_close(told[1], batch.pose.points / wide)
    seen = assess.sensor_frames(trainer, trainer.scenes, 1)
    assert seen.wide == pytest.approx(wide, rel=1e-12)
    assert torch.equal(seen.mask, losses.mask_in_frame(batch.mask, wide))
    net, member = trainer.model.net, smallest_architecture(settings.space)
    plain = assess.predict_frames(net, member, replace(seen, wide=1.0), trainer.inner)
    scaled = assess.predict_frames(net, member, seen, trainer.inner)
    torch.testing.assert_close(scaled.centre, wide * plain.centre)
