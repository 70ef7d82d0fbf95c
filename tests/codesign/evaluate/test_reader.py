"""The reference reader: the same numbers every time, none of depth where the image
holds none, refusals by name.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.evaluate import reader
from codesign.evaluate.reader import ReaderConfig
from codesign.network import blur
from metalens.core.errors import ConfigError

TINY = ReaderConfig(frames=256, pool=64, test=64, pixels=32, pitch_um=36.0)


class _Window:
    """Frames of a stream: white noise whose strength falls with the depth of the whole
    frame, in place of blur.
    """

    def __init__(self, seed, told):
        self.seed, self.told = seed, told

    def __call__(self, optics, scenes, config, count):
        draw = torch.Generator().manual_seed(scenes)
        depth = 16e3 + 12e3 * torch.rand(count, generator=draw)
        vergence = blur.window_vergence(
            depth[:, None, None].expand(-1, 64, 64).contiguous()
        )
        strength = torch.exp(0.5 * vergence[:, :1, :1]) if self.told else 1.0
        pixels = (torch.randn(count, 64, 64, generator=draw) * strength)[:, None]
        slip = torch.stack([0 * depth, 0 * depth, depth * 1e-3 - 22], 1)
        return reader.LensFrames(pixels, vergence, slip)


@pytest.mark.parametrize("told", [True, False])
def test_it_reads_what_the_frames_hold_and_nothing_else(monkeypatch, told):
    """Guessing the middle of a uniform spread of 12 mm errs by 3 mm; power tells the
    depth to a few per cent.
    """
    monkeypatch.setattr(reader, "lens_frames", _Window(3, told))
    seen = reader.JudgingScenes(1, 2, 3)
    found = reader.train_reader(None, seen, replace(TINY, frames=512, test=256))
    axial = float(found.axial_mm.mean())
    if told:
        assert axial < 1.2
        assert float(found.window_mm.mean()) < 0.4 * found.guess_mm
    else:
        assert 2.5 < axial < 3.6
        assert float(found.window_mm.mean()) > 0.9 * found.guess_mm
    assert (
        0.82 < found.covered < 0.97
    )  # 0.9 of 256 frames, calibrated on 256: standard error 0.027
    assert found.guess_mm == pytest.approx(3.0, rel=0.1)
    values = found.values()
    assert values["axial_low_mm"] < values["axial_mm"] < values["axial_high_mm"]


def test_the_same_numbers_come_every_time_and_the_global_generator_is_left_as_it_was(
    monkeypatch,
):
    monkeypatch.setattr(reader, "lens_frames", _Window(3, True))
    found = []
    for state in (11, 12):
        torch.manual_seed(state)
        want = torch.get_rng_state()
        found.append(
            reader.train_reader(
                None, reader.JudgingScenes(1, 2, 3), replace(TINY, frames=128)
            )
        )
        assert torch.equal(torch.get_rng_state(), want)
    assert torch.equal(found[0].axial_mm, found[1].axial_mm)


def test_learning_and_judging_frames_differ_and_repeat():
    seen = reader.render_scenes(
        replace(TINY, pool=32, test=32), sensor_distance_um=2000.0
    )
    batches = [s.batch(0, 32) for s in (seen.learn, seen.calibrate, seen.judge)]
    assert not np.array_equal(batches[0].frames.light, batches[2].frames.light)
    assert not np.array_equal(batches[1].frames.light, batches[2].frames.light)
    again = reader.render_scenes(
        replace(TINY, pool=32, test=32), sensor_distance_um=2000.0
    ).judge.batch(0, 32)
    assert np.array_equal(again.frames.light, batches[2].frames.light)
    assert torch.equal(again.slip_mm, batches[2].slip_mm)


def test_eyes_out_of_the_depths_of_the_psfs_are_refused():
    """Pupils stand 17.5 to 24.5 mm before the lens."""
    with pytest.raises(
        ConfigError, match=r"depths_mm = \(18.0, 40.0\) do not hold the eyes"
    ):
        reader.render_scenes(
            replace(TINY, depths_mm=(18.0, 40.0)), sensor_distance_um=2000.0
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 100}, "multiple of 32"),
        ({"test": 0}, "32 or more"),
        ({"pixels": 8}, "32 to 512 pixels"),
        ({"fwhm_nm": -2.0}, "a width of 0 or more"),
        ({"depths_mm": (31.0, 12.0)}, "0 < least < largest"),
    ],
)
def test_impossible_readers_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        replace(TINY, **change)


def test_lenses_of_different_sensor_distances_are_refused():
    class Lens:
        def __init__(self, distance):
            self.reduced_um = distance

    with pytest.raises(ConfigError, match="compare lenses of one distance"):
        next(reader.judge_lenses({"a": Lens(2000.0), "b": Lens(1000.0)}, TINY))


def test_the_table_names_every_lens_and_the_light():
    one = reader.ReaderResult(
        torch.tensor([0.4, 0.6]),
        torch.tensor([0.2, 0.3]),
        torch.tensor([1.0, 1.4]),
        2.7,
        0.91,
        1.3,
        0.02,
        0.9,
    )
    lines = reader.reader_table(
        {"mine": one}, replace(TINY, fwhm_nm=30.0)
    ).text.splitlines()
    assert "30 nm of light" in lines[0]
    assert "0.50 [0.40, 0.60]" in lines[2]
    assert "±1.30 mm" in lines[2]
    assert "91 %" in lines[2]
    assert "1.20 (2.70)" in lines[2]
