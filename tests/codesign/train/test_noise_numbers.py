"""Noise of frames: shares of one batch between ranks, its variance, and seeds that
belong to stream and number.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.train import assess, formation
from metalens.image import Sensor

CHIP = Sensor(
    pitch_um=6.0,
    base_pitch_um=3.0,
    exposure_e=900.0,
    full_well_e=700.0,
    read_noise_e=4.0,
)


def test_ranks_take_their_parts_of_one_draw(monkeypatch):
    mean = torch.full((3, 4, 5), 500.0, dtype=torch.float64)
    reads = torch.tensor(1.0)

    def made(rank, ranks, size):
        monkeypatch.setattr(formation.parallel, "rank", lambda: rank)
        monkeypatch.setattr(formation.parallel, "ranks", lambda: ranks)
        return formation._normal(
            mean[:size], CHIP, torch.Generator().manual_seed(8), reads
        )

    whole = torch.cat([made(k, 3, 3) for k in range(3)])
    draw = torch.randn(
        (9, 4, 5), generator=torch.Generator().manual_seed(8), dtype=torch.float64
    )
    assert whole.numpy() == pytest.approx(
        (500 + draw * np.sqrt(500 + 16)).numpy(), rel=1e-6
    )


def test_electrons_have_the_variance_of_light_and_reads_up_to_the_full_well():
    """Wells of (6 / 3)² x 700 e; the read noise of a pixel made of 2.25 reads."""
    mean = torch.tensor([[[300.0, 9000.0]]], dtype=torch.float64).expand(20_000, 1, 2)
    got = formation._normal(
        mean, CHIP, torch.Generator().manual_seed(1), torch.tensor(2.25)
    )[:, 0].numpy()
    assert got.mean(0) == pytest.approx([300, 2800], rel=3e-3)
    assert got.var(0) == pytest.approx(
        [300 + 36, 2800 + 36], rel=0.04
    )  # 20000 draws: 1 %


def test_seeds_of_judged_frames_are_of_their_stream_and_number(monkeypatch):
    seeds = []

    def read_out(light, sample_um, pitch, sensor, *, generator):
        seeds.append(generator.initial_seed())
        return light

    part = torch.zeros(2, 1)
    batch = SimpleNamespace(frames=None, mask=torch.zeros(2, 1, 1), slip_mm=part)
    monkeypatch.setattr(assess, "read_out", read_out)
    monkeypatch.setattr(assess, "samples", lambda frames: None)
    monkeypatch.setattr(assess, "irradiance", lambda frames, optics, *, margin: part)
    monkeypatch.setattr(assess, "depth_um", lambda frames, *, margin: part)
    monkeypatch.setattr(assess.formed, "imager", lambda *_, **__: None)
    monkeypatch.setattr(assess.blur, "window_vergence", lambda depth: part)
    trainer = SimpleNamespace(
        inner=SimpleNamespace(batch=2), light=SimpleNamespace(device="cpu"), sensor=None,
        optics=SimpleNamespace(sample_um=1.0),
        model=SimpleNamespace(coefficients_rad=None, pitch_um=torch.tensor(1.0)),
    )  # fmt: skip
    for stream in (0, 4):
        assess.frames(
            trainer,
            SimpleNamespace(batch=lambda number, size: batch, margin=1, stream=stream),
            3,
        )
    assert seeds == [1_000_003 + k for k in range(3)] + [
        5_000_015 + k for k in range(3)
    ]
