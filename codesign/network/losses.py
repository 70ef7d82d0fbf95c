"""Losses of the inner loop: mask, slippage, budget (paper Eqs. 8 and 10). The optics
loss is metalens.fisher's.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from codesign.network.supernet import NetworkPrediction

POINT_UNIT, AXIS_UNIT = 0.05, 0.1  # of the image's width; of a unit vector: 6 degrees


def dice_loss(logits: Tensor, mask: Tensor, *, smooth: float = 1.0) -> Tensor:
    """Mean Dice loss 1 - (2 sum pm + s) / (sum p + sum m + s): 0 for a perfect mask,
    finite for an empty one.

    Args:
        logits: (batch, y, x). mask: (batch, y, x) coverage in [0, 1], of the same size.
        smooth: added to both areas.
    """
    probability = torch.sigmoid(logits)
    intersection = (probability * mask).sum((1, 2))
    total = probability.sum((1, 2)) + mask.sum((1, 2))
    return (1 - (2 * intersection + smooth) / (total + smooth)).mean()


def segmentation_loss(logits: Tensor, mask: Tensor) -> Tensor:
    """Dice loss plus binary cross entropy of the pupil mask.

    The cross entropy has a gradient while mask and logits do not overlap. Both on the
    finer of the two grids, to which logits are interpolated, as in scoring.

    Args:
        logits: (batch, y, x). mask: (batch, y, x) coverage.
    """
    if mask.shape[-1] > logits.shape[-1]:
        logits = F.interpolate(
            logits[:, None], size=mask.shape[-2:], mode="bilinear", align_corners=False
        )[:, 0]
    target = resize_mask(mask, logits)
    return dice_loss(logits, target) + F.binary_cross_entropy_with_logits(
        logits, target
    )


def slip_loss(
    predicted: Tensor, truth: Tensor, scale: Tensor, *, knee: float = 0.3
) -> Tensor:
    """Huber loss of the slippage in units of ``scale``: quadratic, linear beyond
    ``knee``.

    Args:
        predicted: (batch, 3) in units of ``scale``. truth: (batch, 3) in mm.
        scale: (3,) spread in mm. knee: in units of ``scale``.
    """
    return F.smooth_l1_loss(predicted, truth / scale, beta=knee)


def depth_loss(predicted: Tensor, vergence: Tensor) -> Tensor:
    """Gaussian negative log likelihood of window vergences: mean of e² / (2 σ²) + log
    σ.

    Args:
        predicted: (batch, 2, y, x) mean and logarithm of the standard deviation σ.
        vergence: (batch, y, x) the truth.
    """
    mean, log_sd = predicted.unbind(1)
    return F.gaussian_nll_loss(mean, vergence, torch.exp(2 * log_sd))


def task_loss(
    prediction: NetworkPrediction,
    mask: Tensor,
    slip_mm: Tensor,
    scale_mm: Tensor,
    *,
    slip_weight: float,
) -> Tensor:
    """Task loss L_seg + lambda_slip L_calib (paper Eq. 8).

    Args:
        prediction: of the network. mask: (batch, y, x) coverage of the pupil.
        slip_mm: (batch, 3) true slippage.
        scale_mm: (3,) unit of the network's slippage. slip_weight: of the slippage.
    """
    perception = segmentation_loss(prediction.mask_logits, mask)
    return perception + slip_weight * slip_loss(prediction.slip, slip_mm, scale_mm)


def depth_reading_loss(
    prediction: NetworkPrediction,
    vergence: Tensor,
    slip_mm: Tensor,
    scale_mm: Tensor,
    *,
    depth_weight: float,
) -> Tensor:
    """Gaussian negative log likelihoods of window vergences, times lambda_depth, and of
    the slippage's uncertainty, added to the task loss.

    Args:
        prediction: of the network.
        vergence: (batch, y, x) of the windows
            (:func:`codesign.network.blur.window_vergence`).
        slip_mm: (batch, 3) true slippage. scale_mm: (3,) unit of the network's
            slippage.
        depth_weight: of the depths of windows.
    """
    depth = depth_loss(prediction.depth, vergence)
    # the uncertainty of the slippage alone is trained
    error = (prediction.slip - slip_mm / scale_mm).detach()
    variance = torch.exp(2 * prediction.slip_log_sd)
    uncertainty = F.gaussian_nll_loss(error, torch.zeros_like(error), variance)
    return depth_weight * depth + 0.1 * uncertainty  # it moves its own layer alone


def pose_loss(
    prediction: NetworkPrediction,
    axis: Tensor,
    points: Tensor,
    *,
    axis_weight: float,
    point_weight: float,
) -> Tensor:
    """Weighted Huber losses of the landmarks inside the image and of the optic axis.

    Args:
        prediction: of the network. axis: (batch, 3) unit vectors.
        points: (batch, points, 2) as a fraction of the image from its centre.
        axis_weight: of the optic axis. point_weight: of the landmarks.
    """
    inside = (points.abs() < 0.5).all(-1)
    point_error = F.smooth_l1_loss(
        prediction.points / POINT_UNIT, points / POINT_UNIT, beta=0.1, reduction="none"
    ).mean(-1)
    point_loss = (point_error * inside).sum() / inside.sum().clamp_min(1)
    axis_loss = F.smooth_l1_loss(
        prediction.axis / AXIS_UNIT, axis / AXIS_UNIT, beta=0.3
    )
    return axis_weight * axis_loss + point_weight * point_loss


def over_budget(macs: Tensor, budget: float) -> Tensor:
    """[C_total - C_budget]_+ relative to the budget (paper Eq. 10).

    Args:
        macs: multiply-accumulates of every member.
    """
    return F.relu(macs / budget - 1)


def resize_mask(mask: Tensor, like: Tensor) -> Tensor:
    """Mask coverage averaged onto the grid of the logits.

    Args:
        mask: (batch, y, x) coverage. like: (batch, y, x) on the wanted grid.
    """
    return F.interpolate(mask[:, None], size=like.shape[-2:], mode="area")[:, 0]


def mask_in_frame(mask: Tensor, wide: float) -> Tensor:
    """Coverage on a frame ``wide`` times as wide as the image of the mask, about its
    centre.

    0 outside the image. As many cells as the mask has, each the mean of the mask under
    it.

    Args:
        mask: (batch, y, x) coverage. wide: width of the frame over that of the image.
    """
    if wide == 1:
        return mask
    size = int(mask.shape[-1])
    cell = torch.arange(size, dtype=torch.float64)
    edge = (torch.arange(size + 1, dtype=torch.float64) - size / 2) * wide + size / 2
    overlap = torch.minimum(edge[1:, None], cell + 1) - torch.maximum(
        edge[:-1, None], cell
    )
    weights = (overlap.clamp_min(0) / wide).to(mask)
    return weights @ mask @ weights.mT


def at_pixels(logits: Tensor, mask: Tensor, pixels: int) -> tuple[Tensor, Tensor]:
    """Interpolated logits and averaged mask coverage on a grid of ``pixels`` along a
    side.

    Args:
        logits: (batch, y, x) log odds of the pupil. mask: (batch, y, x) coverage.
        pixels: along a side.
    """
    size = (pixels, pixels)
    logits = F.interpolate(
        logits[:, None], size=size, mode="bilinear", align_corners=False
    )[:, 0]
    # averaged to the pixels; a mask that is coarser than these is interpolated
    coarse = min(pixels, *mask.shape[-2:])
    mask = F.interpolate(mask[:, None], size=(coarse, coarse), mode="area")
    mask = F.interpolate(mask, size=size, mode="bilinear", align_corners=False)
    return logits, mask[:, 0]


def mask_iou(logits: Tensor, mask: Tensor, *, pixels: int | None = None) -> Tensor:
    """(batch,) intersection over union of the masks thresholded at 1/2.

    1 where both are empty.

    Args:
        logits: (batch, y, x) log odds. mask: (batch, y, x) coverage.
        pixels: along a side of the grid that both are brought to: logits interpolated,
            coverage averaged. The sensor's pixels score what a user of the mask gets;
            without it the grid of the logits serves.
    """
    if pixels is not None:
        logits, mask = at_pixels(logits, mask, pixels)
    predicted = logits > 0
    truth = resize_mask(mask, logits) > 0.5
    union = (predicted | truth).sum((1, 2))
    intersection = (predicted & truth).sum((1, 2))
    return torch.where(
        union > 0,
        intersection / union.clamp_min(1),
        torch.ones_like(intersection, dtype=torch.float32),
    )
