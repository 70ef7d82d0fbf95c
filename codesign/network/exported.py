"""A network as one ONNX graph: frames of the sensor in, lengths and angles out, as gaze
is calibrated from.
"""

import copy
import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from codesign.eye import CameraRig
from codesign.network.architecture import Architecture
from codesign.network.supernet import Supernet
from metalens.core.store import replace_atomically

FRAMES = "pixels of the sensor, rows from the top, in any unit: every frame is brought to mean 0 and deviation 1"
OUTPUTS = {  # name: what it is
    "mask_logits": "(batch, y, x) log odds of the pupil, on a grid over the whole frame",
    "pupil_mm": "(batch, 2) x right and y down of the pupil on the sensor, upright image, from the lens axis, mm",
    "slip_mm": "(batch, 3) displacement of the head before the camera: x right, y down, z away from the lens, mm",
    "slip_sd_mm": "(batch, 3) standard deviation that the network gives it, not calibrated, mm",
    "points_mm": "(batch, 10, 2) nine landmarks (codesign.eye.NAMES) and the pupil's middle, as pupil_mm",
    "axis_deg": "(batch, 2) angles of the optic axis across (right +) and down in the frame of the face, deg",
    "pupil_area_mm2": "(batch,) area of the pupil on the sensor, near 0 behind closed lids, mm²",
}


@dataclass(frozen=True, slots=True)
class OutputScale:
    """What turns a network's outputs into lengths and angles.

    frame_mm: edge of all pixels. slip_mm: unit of the slippage. rig: pose of the camera.
    axis, points: whether training gave them weight; what it did not is
    left out.
    """

    frame_mm: float
    slip_mm: tuple[float, float, float]
    rig: CameraRig
    axis: bool = True
    points: bool = True

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of what the graph gives, in order."""
        left_out = {"points_mm": not self.points, "axis_deg": not self.axis}
        return tuple(name for name in OUTPUTS if not left_out.get(name, False))


class ExportedNetwork(nn.Module):
    """``forward(frames) -> (outputs...)`` in the order of :attr:`Scale.outputs`; frames
    (batch, 1, size, size).
    """

    def __init__(
        self, net: Supernet, architecture: Architecture, scale: OutputScale
    ) -> None:
        super().__init__()
        self.net = copy.deepcopy(net).cpu()
        self.architecture, self.scale = architecture, scale
        self.eval()

    def forward(self, frames: Tensor) -> tuple[Tensor, ...]:
        """Outputs of standardised frames (batch, 1, size, size) in mm and degrees."""
        centred = frames - frames.mean((-2, -1), keepdim=True)
        size = int(frames.shape[-1])
        deviation = torch.sqrt((centred**2).sum((-2, -1), keepdim=True) / (size**2 - 1))
        prediction = self.net(centred / deviation.clamp_min(1e-6), self.architecture)
        unit = torch.tensor(self.scale.slip_mm)
        outputs = {
            "mask_logits": prediction.mask_logits,
            "pupil_mm": prediction.centre * self.scale.frame_mm,
            "slip_mm": prediction.slip * unit,
            "slip_sd_mm": prediction.slip_log_sd.exp() * unit,
            "points_mm": prediction.points * self.scale.frame_mm,
            "axis_deg": self._angles(prediction.axis),
            "pupil_area_mm2": torch.sigmoid(prediction.mask_logits).mean((1, 2))
            * self.scale.frame_mm**2,
        }
        return tuple(outputs[name] for name in self.scale.outputs)

    def _angles(self, axis: Tensor) -> Tensor:
        """(batch, 2) angles across and down, deg, of optic axes of any length."""
        right, down, out = (axis @ self.scale.rig.face_axes.to(axis).mT).unbind(1)
        horizontal = torch.sqrt(right**2 + out**2)
        return torch.stack(
            [torch.atan2(right, out), torch.atan2(down, horizontal)], 1
        ) * (180 / math.pi)


def write_onnx(
    path: str | Path,
    net: Supernet,
    architecture: Architecture,
    scale: OutputScale,
    *,
    size: int,
    pitch_um: float,
) -> None:
    """Write an ONNX file (opset 17) of a network, for any number of square frames.

    Inputs and outputs are described in the file with their units, and its properties
    describe the camera.

    Args:
        path: of the file. net: elastic network, with the batch statistics of the
            architecture. architecture: whose weights the file holds, and no others.
        scale: units of the outputs.
        size: pixels along a side of a frame. pitch_um: of the pixels.

    Accuracy:
        onnxruntime against torch, float32 through some forty layers in another order:
        1e-4 of a logit, mm or degree.

    Raises:
        OSError: the target cannot be written.
    """
    import onnx

    network = ExportedNetwork(net, architecture, scale)
    example = torch.zeros(2, 1, size, size)
    names = scale.outputs
    with replace_atomically(path) as part:
        with warnings.catch_warnings():
            # of fixed sizes, which are intended, and of the exporter's age
            warnings.simplefilter("ignore")
            torch.onnx.export(
                network, (example,), str(part), dynamo=False, input_names=["frames"], output_names=list(names),
                opset_version=17, dynamic_axes={name: {0: "batch"} for name in ("frames", *names)},
            )  # fmt: skip
        camera = {
            "pixels": size,
            "pitch_um": pitch_um,
            "frame_mm": scale.frame_mm,
            "elevation_rad": scale.rig.elevation_rad,
            "azimuth_rad": scale.rig.azimuth_rad,
            "right_eye": scale.rig.right_eye,
        }
        graph_file = onnx.load(str(part))
        graph_file.graph.input[0].doc_string = FRAMES
        for value in graph_file.graph.output:
            value.doc_string = OUTPUTS[value.name]
        about = {name: repr(value) for name, value in camera.items()}
        onnx.helper.set_model_props(graph_file, about)
        part.write_bytes(graph_file.SerializeToString())
