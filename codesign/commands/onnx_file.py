"""A run's network as ONNX, with the scale of the run: lengths on its sensor, slippage
in mm, angles of the face.
"""

from pathlib import Path

from codesign.batches import EXPERIMENT
from codesign.network import Architecture, Supernet, exported
from codesign.train import CodesignRun
from metalens.psf import pixel_count


def write_network_file(
    path: Path, run: CodesignRun, net: Supernet, architecture: Architecture
) -> None:
    """Write a network of a run, cut to its architecture, for frames of the run's
    sensor.

    Args:
        path: of the file. net: elastic network.

    Raises:
        OSError: the target cannot be written.
    """
    inner, settings = run.settings.inner, run.settings
    pitch_um = float(run.trainer.model.pitch_um.detach())
    size = pixel_count(settings.scenes.pixels, settings.optics.sample_um, pitch_um)
    scale = exported.OutputScale(
        frame_mm=size * pitch_um * 1e-3,
        slip_mm=inner.slip_scale_mm,
        rig=run.scenes(EXPERIMENT).rig,
        axis=inner.axis_weight > 0,
        points=inner.point_weight > 0,
    )
    exported.write_onnx(path, net, architecture, scale, size=size, pitch_um=pitch_um)
