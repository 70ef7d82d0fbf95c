"""What a run's files say is what its network does after fine-tuning."""

import json

import pytest
import torch

from codesign.adapt import source as finished
from tests.codesign import made_lens as m
from tests.command_line import call

SHORT = m.TINY.replace("steps = 1", "steps = 4").replace(
    'preset = "smoke"', 'preset = "smoke"\ncheckpoint_every = 2'
)


def _run(folder, text, *words):
    folder.mkdir()
    (folder / "run.toml").write_text(text)
    out = folder / "out"
    assert call(f"codesign {folder}/run.toml -o {out}", *words) == 0
    return out


def test_a_fine_tuned_network_is_read_back_as_it_was_exported(tmp_path):
    """Frames through onnxruntime and through the network that retraining, experiment
    and budget load; the supernet before fine-tuning answers otherwise.
    """
    onnxruntime = pytest.importorskip("onnxruntime")
    text = SHORT.replace("[run]", "[run]\nfinetune_steps = 6")
    out = _run(tmp_path / "tuned", text, "--export")
    source = finished.load_finished_run(out)
    session = onnxruntime.InferenceSession(out / "subnet_2.onnx")
    generator = torch.Generator().manual_seed(3)
    size = session.get_inputs()[0].shape[-1]
    frames = torch.randn(3, 1, size, size, generator=generator)
    frames = (frames - frames.mean((2, 3), keepdim=True)) / frames.std(
        (2, 3), keepdim=True
    )
    names = [value.name for value in session.get_outputs()]
    given = dict(zip(names, session.run(None, {"frames": frames.numpy()}), strict=True))
    net = source.run.trainer.model.net.eval()
    scale = torch.tensor(source.settings.inner.slip_scale_mm)
    with torch.no_grad():
        slip = (net(frames, source.architecture).slip * scale).numpy()
    # float32 through forty layers in another order: 1e-4
    assert abs(slip - given["slip_mm"]).max() < 1e-3
    (tmp_path / "plain").mkdir()
    row = json.loads((out / "result.json").read_text())["rows"][0]
    assert row["budget_mmacs"] == 2.0
    from codesign.train import run as runs

    raw = runs.resume_run(out / "checkpoint.safetensors", source.settings)
    before = raw.trainer.model.net.state_dict()["calibration.slip.weight"]
    after = net.state_dict()["calibration.slip.weight"]
    assert float((before - after).abs().max()) > 1e-5
