"""An exported graph against the network it was made of: the same numbers in the units
that it says, for any batch.
"""

import ast
import copy
import dataclasses

import numpy as np
import pytest
import torch

from codesign.eye import CameraRig
from codesign.network import architecture as arch
from codesign.network import exported
from codesign.network.supernet import Supernet, recalibrate_batch_norm

SPACE = arch.SearchSpace()
SCALE = exported.OutputScale(
    frame_mm=1.87, slip_mm=(1.4, 0.9, 2.3), rig=CameraRig(elevation_rad=0.6)
)


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return Supernet(SPACE)


def _frames(count, size, seed=1):
    return torch.randn(
        count, 1, size, size, generator=torch.Generator().manual_seed(seed)
    )


def _angles_deg(axis, elevation):
    """By the camera's place below the face: its z points to the face, which is turned
    about x by the elevation.
    """
    x, y, z = axis.T / np.linalg.norm(axis, axis=1)
    down = np.cos(elevation) * y - np.sin(elevation) * z
    out = -np.sin(elevation) * y - np.cos(elevation) * z
    return np.degrees(np.stack([np.arctan2(x, out), np.arcsin(down)], 1))


CASES = [(1.0, 61), (0.6, 100)]  # resolution, size


@pytest.fixture(scope="module")
def graphs(net, tmp_path_factory):
    """Of each case its architecture, its network and its file."""
    pytest.importorskip("onnx")
    made = {}
    for resolution, size in CASES:
        chosen = dataclasses.replace(
            arch.smallest_architecture(SPACE), resolution=resolution
        )
        recalibrate_batch_norm(net, chosen, [_frames(4, size)])
        path = tmp_path_factory.mktemp("graph") / "n.onnx"
        exported.write_onnx(path, net, chosen, SCALE, size=size, pitch_um=30.0)
        made[resolution, size] = chosen, copy.deepcopy(net), path
    return made


@pytest.mark.parametrize("case", CASES)
def test_a_graph_gives_the_network_s_answers_in_lengths_and_angles(graphs, case):
    """Levels of a sensor, 512 with a spread of 90, in place of standardised frames;
    batches of one and three.
    """
    onnxruntime = pytest.importorskip("onnxruntime")
    _, size = case
    chosen, net, path = graphs[case]
    session = onnxruntime.InferenceSession(path)
    for count in (1, 3):
        plain = _frames(count, size, seed=count)
        plain = (plain - plain.mean((2, 3), keepdim=True)) / plain.std(
            (2, 3), keepdim=True
        )
        found = session.run(None, {"frames": (512 + 90 * plain).numpy()})
        with torch.no_grad():
            want = net(plain, chosen)
        unit = np.array(SCALE.slip_mm)
        told = {
            "mask_logits": want.mask_logits.numpy(),
            "pupil_mm": 1.87 * want.centre.numpy(),
            "slip_mm": want.slip.numpy() * unit,
            "slip_sd_mm": np.exp(want.slip_log_sd.numpy()) * unit,
            "points_mm": 1.87 * want.points.numpy(),
            "axis_deg": _angles_deg(want.axis.double().numpy(), 0.6),
            "pupil_area_mm2": (1.87**2 / (1 + np.exp(-want.mask_logits.numpy()))).mean(
                (1, 2)
            ),
        }
        assert [value.name for value in session.get_outputs()] == list(told)
        for value, (name, expected) in zip(found, told.items(), strict=True):
            # float32 through 40 layers in another order; an axis of untrained weights
            # is 0.1 long: ten times in degrees
            assert np.abs(value - expected).max() < (
                3e-3 if name == "axis_deg" else 3e-4
            ), name
    assert session.get_outputs()[5].shape == ["batch", 2]


def test_a_file_says_what_it_holds_and_leaves_out_what_nothing_trained(
    graphs, tmp_path
):
    import onnx

    chosen, net, path = graphs[CASES[0]]
    bare = dataclasses.replace(SCALE, axis=False, points=False)
    exported.write_onnx(tmp_path / "bare", net, chosen, bare, size=61, pitch_um=30.0)
    whole, cut = (onnx.load(name) for name in (path, tmp_path / "bare"))
    onnx.checker.check_model(whole, full_check=True)
    assert [v.name for v in cut.graph.output] == [
        "mask_logits",
        "pupil_mm",
        "slip_mm",
        "slip_sd_mm",
        "pupil_area_mm2",
    ]
    assert {
        v.name: v.doc_string[-2:] for v in whole.graph.output if v.name.endswith("_mm")
    } == dict.fromkeys(["pupil_mm", "slip_mm", "slip_sd_mm"], "mm") | {
        "points_mm": "mm"
    }
    held = sum(np.prod(v.dims) for v in whole.graph.initializer)
    assert held < 0.6 * sum(p.numel() for p in net.parameters())  # no other network's
    assert whole.graph.output[5].doc_string.endswith("deg")
    about = {p.key: ast.literal_eval(p.value) for p in whole.metadata_props}
    assert about == {
        "pixels": 61,
        "pitch_um": 30.0,
        "frame_mm": 1.87,
        "elevation_rad": 0.6,
        "azimuth_rad": 0.0,
        "right_eye": False,
    }
