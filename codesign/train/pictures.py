"""What a run shows: pictures of it as it stands, and at its end test frames with the
answers of its networks.
"""

import copy

import numpy as np
import torch
from torch import Tensor

from codesign.batches import VALIDATION
from codesign.network import blur, losses, recalibrate_batch_norm, smallest_architecture
from codesign.optics import stack as lens
from codesign.train import assess
from codesign.train.finish import BudgetResult
from codesign.train.formation import depth_information
from codesign.train.run import CodesignRun
from metalens.core import report
from metalens.core.arrays import Array


@torch.no_grad()
def all_of(run: CodesignRun) -> dict[str, bytes]:
    """PNG pictures by name: psf, frames, masks.

    The run stays as it is: masks come from a copy of the network, whose batch
    statistics are measured in evaluation mode on the frames that are shown.
    """
    trainer = run.trainer
    made = lens.lens_psf_stack(trainer.optics, trainer.model.coefficients_rad)
    chosen = torch.linspace(0, len(made.depths_um) - 1, 6).long().tolist()
    titles = [f"{float(made.depths_um[i]) * 1e-3:.0f} mm" for i in chosen]
    pictures = {
        "psf": _row([made.intensity[i].clamp_min(0).sqrt() for i in chosen], titles)
    }
    seen = assess.sensor_frames(trainer, run.scenes(VALIDATION), 1)
    shown = min(6, len(seen.frames))
    pictures["frames"] = _row(list(seen.frames[:shown, 0]), [""] * shown)
    net = copy.deepcopy(trainer.model.net)  # the run's own statistics must not move
    recalibrate_batch_norm(net, smallest_architecture(net.space), [seen.frames])
    found = net(seen.frames, smallest_architecture(net.space)).mask_logits.cpu()
    if found.numel():
        pictures["masks"] = _row(list(torch.sigmoid(found[:shown])), [""] * shown)
    return pictures


def _row(images: list[Tensor], titles: list[str]) -> bytes:
    figure, _ = report.make_figure(size=(1.6 * len(images), 1.8))
    figure.clear()
    for k, (image, title) in enumerate(zip(images, titles, strict=True)):
        axes = figure.add_subplot(1, len(images), k + 1)
        axes.imshow(image.numpy(), cmap="gray")
        axes.set_title(title)
        axes.set_axis_off()
    return report.figure_png(figure)


@torch.no_grad()
def window_depth_bound(run: CodesignRun) -> dict[str, list[float]]:
    """Least standard deviation, in mm, of a reader of the blur of one window, on axis,
    over the depth.

    Of a window of 1/f texture as wide as the PSFs, with noise of a thousandth of its
    power: see
    :func:`codesign.train.formation.depth_information`.

    Args:
        run: run with its model.
    """
    made = lens.lens_psf_stack(run.trainer.optics, run.trainer.model.coefficients_rad)
    told = depth_information(made)
    middle = (made.depths_um[1:] + made.depths_um[:-1]) / 2
    return {
        "depth_mm": (1e-3 * middle).tolist(),
        "window_depth_mm": told.clamp_min(1e-12).rsqrt().tolist(),
    }


def predictions_of_frames(ends: list[BudgetResult], count: int) -> dict[str, Array]:
    """The first test frames and what each network said of them.

    Args:
        ends: one a compute budget. count: how many.

    Returns:
        frames (n, y, x) as the network sees them; pupil (n, y, x) and slip_um (n, 3),
        true; told_pupil (networks, n, y,
        x) share of the pixel, told_slip_um (networks, n, 3); interval_um (networks, n)
        half width of the 90 % interval
        of the distance, nan where none is given; window_um (n, windows, windows) true
        depth and told_window_um
        (networks, n, windows, windows). What no network tells is left out.
    """
    seen, networks = ends[0].seen, [end.answers for end in ends]
    pixels = int(seen.frames.shape[-1])
    out = {"frames": seen.frames[:count, 0], "slip_um": 1e3 * seen.slip_mm[:count]}
    out["told_slip_um"] = torch.stack([1e3 * a.slip_mm[:count] for a in networks])
    none = torch.full((min(count, len(seen.frames)),), torch.nan)
    wide = [
        none if end.interval_mm is None else 1e3 * end.interval_mm[:count]
        for end in ends
    ]
    out["interval_um"] = torch.stack(wide)
    logits = [a.mask for a in networks if a.mask is not None]
    if len(logits) == len(networks):
        both = [
            losses.at_pixels(mask[:count], seen.mask[:count], pixels) for mask in logits
        ]
        out |= {
            "pupil": both[0][1],
            "told_pupil": torch.stack([torch.sigmoid(found) for found, _ in both]),
        }
    windows = [a.depth[:count, 0] for a in networks if a.depth is not None]
    if seen.vergence is not None and len(windows) == len(networks):
        out["window_um"] = 1e3 * blur.depth_mm(seen.vergence[:count])
        out["told_window_um"] = 1e3 * blur.depth_mm(torch.stack(windows))
    return {
        name: np.asarray(value.cpu().numpy(), np.float32) for name, value in out.items()
    }
