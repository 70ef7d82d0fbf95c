"""Pictures of a run as it stands: PSFs over depth, frames as the sensor gives them, masks as the network sees them."""

import torch
from torch import Tensor

from codesign.batches import VALIDATION
from codesign.network import smallest
from codesign.optics import stack as lens
from codesign.train import assess
from codesign.train.run import Run
from metalens.ground import report


@torch.no_grad()
def all_of(run: Run) -> dict[str, bytes]:
    """PNG pictures by name: psf, frames, masks."""
    trainer = run.trainer
    made = lens.stack(trainer.optics, trainer.model.coefficients_rad)
    chosen = torch.linspace(0, len(made.depths_um) - 1, 6).long().tolist()
    titles = [f"{float(made.depths_um[i]) * 1e-3:.0f} mm" for i in chosen]
    pictures = {"psf": _row([made.intensity[i].clamp_min(0).sqrt() for i in chosen], titles)}
    seen = assess.frames(trainer, run.scenes(VALIDATION), 1)
    shown = min(6, len(seen.frames))
    pictures["frames"] = _row(list(seen.frames[:shown, 0]), [""] * shown)
    net = trainer.model.net
    was, _ = net.training, net.train()  # batch statistics of these frames: the supernet keeps none
    found = net(seen.frames, smallest(net.space)).mask_logits
    net.train(was)
    if found.numel():
        pictures["masks"] = _row(list(torch.sigmoid(found[:shown])), [""] * shown)
    return pictures


def _row(images: list[Tensor], titles: list[str]) -> bytes:
    figure, _ = report.canvas(size=(1.6 * len(images), 1.8))
    figure.clear()
    for k, (image, title) in enumerate(zip(images, titles, strict=True)):
        axes = figure.add_subplot(1, len(images), k + 1)
        axes.imshow(image.numpy(), cmap="gray")
        axes.set_title(title)
        axes.set_axis_off()
    return report.png(figure)
