"""A run's network as ONNX, with the scale of the run: lengths on its sensor, slippage
in mm, angles of the face.
"""

from pathlib import Path

from codesign.batches import EXPERIMENT
from codesign.network import Architecture, Supernet, exported
from codesign.network.subnet import Subnet
from codesign.train import CodesignRun
from metalens.psf import pixel_count


def scale_of(run: CodesignRun) -> exported.OutputScale:
    """What a run's networks answer in."""
    inner = run.settings.inner
    pitch = float(run.trainer.model.pitch_um.detach())
    return exported.OutputScale(
        frame_mm=pixels_of(run) * pitch * 1e-3,
        slip_mm=inner.slip_scale_mm,
        elevation_rad=run.scenes(EXPERIMENT).rig.elevation_rad,
        axis=inner.axis_weight > 0,
        points=inner.point_weight > 0,
    )


def pixels_of(run: CodesignRun) -> int:
    """Pixels along a side of the run's sensor."""
    settings = run.settings
    pitch = float(run.trainer.model.pitch_um.detach())
    return pixel_count(settings.scenes.pixels, settings.optics.sample_um, pitch)


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
    pitch = float(run.trainer.model.pitch_um.detach())
    exported.write_onnx(
        path,
        Subnet(net, architecture),
        scale_of(run),
        size=pixels_of(run),
        pitch_um=pitch,
    )
