"""Sets of states: reproducible, triplets in the linear regime, pairs with one centroid,
shards that read back.
"""

import torch

from codesign.eye import dataset, renderer
from codesign.eye.population import EyeStates
from codesign.eye.renderer import PinholeCamera

CAMERA = PinholeCamera(pixels=80, pitch_um=18.0)


def test_same_seed_same_frames_whoever_asks():
    whole = dataset.states_at(torch.arange(8), 3)
    parts = [
        dataset.states_at(torch.arange(k, 8, 3), 3) for k in range(3)
    ]  # three workers
    order = torch.cat([torch.arange(k, 8, 3) for k in range(3)])
    for name in EyeStates.__slots__:
        assert torch.equal(
            getattr(whole, name)[order], torch.cat([getattr(p, name) for p in parts])
        )
    assert torch.equal(
        renderer.render(whole, camera=CAMERA).pinhole()[order],
        torch.cat([renderer.render(p, camera=CAMERA).pinhole() for p in parts]),
    )


def test_triplets_are_in_the_linear_regime():
    """The error against the exact derivatives is small at the default steps, and grows
    with them.
    """
    states = dataset.states_at(torch.arange(6), 1)
    exact = renderer.render_sensitivities(states, camera=CAMERA)
    for name, want in (("gaze", exact.first), ("slip", exact.second)):
        errors = []
        for part in (4.0, 1.0):
            t = dataset.render_triplets(
                states,
                gaze_step_rad=3.5e-5 * part,
                slip_step_um=1.0 * part,
                camera=CAMERA,
            )
            step = t.gaze_step_rad if name == "gaze" else t.slip_step_um
            rate = (getattr(t, name).pinhole() - t.anchor.pinhole()) / step
            slope = want.radiance.sum(1)
            errors.append(float((rate - slope).norm() / slope.norm()))
        assert errors[1] < 0.1
        assert errors[1] < 0.6 * errors[0]


def test_ambiguous_pairs_share_the_pupil_centroid():
    pairs = dataset.ambiguity_pairs(12, 5, camera=CAMERA, tolerance_px=0.1)
    a, b = (
        renderer.render(s, camera=CAMERA).labels for s in (pairs.first, pairs.second)
    )
    assert len(pairs.first) == 12
    assert float((a.centroid_px - b.centroid_px).norm(dim=1).max()) <= 0.1
    assert float((a.slip_um - b.slip_um).norm(dim=1).min()) >= 800
    angle = torch.rad2deg(
        torch.arccos((a.optic_axis * b.optic_axis).sum(1).clamp(-1, 1))
    )
    assert float(angle.median()) > 2.0
    assert torch.equal(pairs.first.traits, pairs.second.traits)
    assert (
        float(pairs.distance_px.median()) <= 0.03
    )  # the last Newton step starts 0.3 of the tolerance off, or nearer


def test_shards_read_back_within_their_rounding(tmp_path):
    want = renderer.render(dataset.states_at(torch.arange(5), 2), camera=CAMERA)
    path, other = tmp_path / "scene.h5", tmp_path / "again.h5"
    dataset.write_shard(path, want, seed=2)
    frames, pupil, labels = dataset.read_shard(path)
    assert (
        float((frames.radiance - want.frames.radiance.clamp(0, 1)).abs().max())
        <= 0.51 / 255
    )
    assert float((pupil - want.pupil).abs().max()) <= 0.51 / 255
    seen = want.frames.coverage > 0
    assert float(((frames.depth_um - want.frames.depth_um) * seen).abs().max()) <= 0.51
    assert torch.equal(labels["slip_um"], want.labels.slip_um)
    dataset.write_shard(
        other,
        renderer.render(dataset.states_at(torch.arange(5), 2), camera=CAMERA),
        seed=2,
    )
    assert other.read_bytes() == path.read_bytes()
