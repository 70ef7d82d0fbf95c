"""Losses of the inner loop: mask, slippage, budget (paper Eqs. 8 and 10). The optics
loss is metalens.fisher's.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from codesign.network.supernet import Prediction

SPREAD_WEIGHT = 0.1  # of the uncertainty's own loss: it moves its own layer alone
POINT_UNIT, AXIS_UNIT = 0.05, 0.1  # of the image's width; of a unit vector: 6 degrees
POINT_KNEE, AXIS_KNEE = (
    0.1,
    0.3,
)  # of these units: straight beyond half a per cent of the image, and 2 degrees


def dice_loss(logits: Tensor, mask: Tensor, *, smooth: float = 1.0) -> Tensor:
    """Mean Dice loss 1 - (2 sum pm + s) / (sum p + sum m + s): 0 for a perfect mask,
    finite for an empty one.

    Args:
        logits: (batch, y, x). mask: (batch, y, x) coverage in [0, 1], of the same size.
        smooth: added to both areas.
    """
    probability = torch.sigmoid(logits)
    both = (probability * mask).sum((1, 2))
    either = probability.sum((1, 2)) + mask.sum((1, 2))
    return (1 - (2 * both + smooth) / (either + smooth)).mean()


def segmentation_loss(logits: Tensor, mask: Tensor) -> Tensor:
    """Dice loss plus cross entropy, which carries the gradient while the mask is still
    far off.

    On the finer grid of the two, to which the logits are interpolated, as who scores
    them does.
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
    """Squared error of the slippage in units of ``scale``, linear beyond ``knee`` so
    that outliers do not rule.

    Args:
        predicted: (batch, 3) in units of ``scale``. truth: (batch, 3) in mm. scale:
            (3,) spread in mm.
    """
    return F.smooth_l1_loss(predicted, truth / scale, beta=knee)


def depth_loss(predicted: Tensor, vergence: Tensor) -> Tensor:
    """Negative log likelihood of the windows' vergences under normal distributions,
    less its constant.

    Args:
        predicted: (batch, 2, y, x) mean and logarithm of the standard deviation. vergence:
            (batch, y, x) the truth.
    """
    miss = predicted[:, 0] - vergence
    return (0.5 * miss**2 * torch.exp(-2 * predicted[:, 1]) + predicted[:, 1]).mean()


def uncertainty_loss(found: Prediction, truth: Tensor) -> Tensor:
    """Gaussian negative log likelihood with detached errors: trains the uncertainty
    alone; 0 for a network without one.

    Args:
        truth: (batch, 3) slippage in units of its scale.
        found: of the network.
    """
    if found.slip_log_sd is None:
        return found.slip.new_zeros(())
    miss = (found.slip - truth).detach()
    return (
        0.5 * miss**2 * torch.exp(-2 * found.slip_log_sd) + found.slip_log_sd
    ).mean()


def task_loss(
    found: Prediction,
    mask: Tensor,
    slip_mm: Tensor,
    scale_mm: Tensor,
    *,
    slip_weight: float,
) -> Tensor:
    """L_task = L_seg + lambda_slip L_calib; a network without a mask is held to the
    pupil's centre in its place.

    Args:
        found: of the network. slip_mm: (batch, 3) true slippage.
        scale_mm: (3,) unit of the network's slippage. slip_weight: of the slippage.
    """
    seen = (
        segmentation_loss(found.mask_logits, mask)
        if found.mask_logits.numel()
        else position_loss(found.centre, mask)
    )
    return seen + slip_weight * slip_loss(found.slip, slip_mm, scale_mm)


def depth_reading_loss(
    found: Prediction,
    vergence: Tensor,
    slip_mm: Tensor,
    scale_mm: Tensor,
    *,
    depth_weight: float,
) -> Tensor:
    """lambda_depth L_depth + the uncertainty's own loss: what a network that reads
    depth is trained on beside the task.

    Args:
        vergence: (batch, y, x) of the windows
            (:func:`codesign.network.blur.window_vergence`).
        found: of the network. slip_mm: (batch, 3) true slippage.
        scale_mm: (3,) unit of the network's slippage.
        depth_weight: of the depths of windows.
    """
    depth_term = (
        found.slip.new_zeros(())
        if found.depth is None
        else depth_weight * depth_loss(found.depth, vergence)
    )
    return depth_term + SPREAD_WEIGHT * uncertainty_loss(found, slip_mm / scale_mm)


def pose_loss(
    found: Prediction,
    axis: Tensor,
    points: Tensor,
    *,
    axis_weight: float,
    point_weight: float,
) -> Tensor:
    """Loss of the landmarks inside the image and of the optic axis; 0 for a network
    without them.

    Args:
        axis: (batch, 3) unit vectors. points: (batch, points, 2) as a fraction of the
            image from its middle.
        found: of the network. axis_weight: of the optic axis.
        point_weight: of the landmarks.
    """
    if found.points is None or found.axis is None:
        return found.slip.new_zeros(())
    inside = (points.abs() < 0.5).all(-1)
    miss = F.smooth_l1_loss(
        found.points / POINT_UNIT,
        points / POINT_UNIT,
        beta=POINT_KNEE,
        reduction="none",
    ).mean(-1)
    seen = (miss * inside).sum() / inside.sum().clamp_min(1)
    turned = F.smooth_l1_loss(found.axis / AXIS_UNIT, axis / AXIS_UNIT, beta=AXIS_KNEE)
    return axis_weight * turned + point_weight * seen


def position_loss(
    centre: Tensor, mask: Tensor, *, unit: float = 0.02, knee: float = 0.3
) -> Tensor:
    """Distance of the pupil's centre from the centroid of its mask, in units of 2 % of
    the frame; 0 for empty masks.

    Args:
        centre: (batch, 2) x, y as a fraction of the frame from its middle. mask:
            (batch, y, x) coverage.
        unit: length that the loss divides by.
        knee: from which the loss is linear, in units.
    """
    total = mask.sum((1, 2))
    y, x = (
        (torch.arange(n, dtype=mask.dtype, device=mask.device) + 0.5) / n - 0.5
        for n in mask.shape[-2:]
    )
    truth = (
        torch.stack([(mask.sum(1) * x).sum(1), (mask.sum(2) * y).sum(1)], -1)
        / total.clamp_min(1e-6)[:, None]
    )
    each = F.smooth_l1_loss(
        centre / unit, truth / unit, beta=knee, reduction="none"
    ).mean(1)
    seen = total > 0.5
    return (each * seen).sum() / seen.sum().clamp_min(1)


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
    if mask.shape[-2:] == like.shape[-2:]:
        return mask
    return F.interpolate(mask[:, None], size=like.shape[-2:], mode="area")[:, 0]


def mask_in_frame(mask: Tensor, wide: float) -> Tensor:
    """Coverage over a frame ``wide`` times as wide as the image that the mask is of,
    about its middle; 0 beyond it.

    On as many cells: the mask's own where the frame is as wide as the image.
    """
    if wide == 1:
        return mask
    size = int(mask.shape[-1])
    cell = torch.arange(size, dtype=torch.float64)
    edge = (torch.arange(size + 1, dtype=torch.float64) - size / 2) * wide + size / 2
    shared = torch.minimum(edge[1:, None], cell + 1) - torch.maximum(
        edge[:-1, None], cell
    )
    weights = (shared.clamp_min(0) / wide).to(mask)
    return weights @ mask @ weights.mT


def at_pixels(logits: Tensor, mask: Tensor, pixels: int) -> tuple[Tensor, Tensor]:
    """Logits, interpolated, and the mask's coverage, averaged, on a grid of ``pixels``
    along a side.

    Args:
        logits: (batch, y, x) log odds of the pupil.
    """
    size = (pixels, pixels)
    logits = F.interpolate(
        logits[:, None], size=size, mode="bilinear", align_corners=False
    )[:, 0]
    coarse = min(
        pixels, *mask.shape[-2:]
    )  # a mask that was kept coarser than the pixels is interpolated
    mask = F.interpolate(mask[:, None], size=(coarse, coarse), mode="area")
    return logits, F.interpolate(mask, size=size, mode="bilinear", align_corners=False)[
        :, 0
    ]


def mask_iou(logits: Tensor, mask: Tensor, *, pixels: int | None = None) -> Tensor:
    """(batch,) intersection over union of the thresholded masks; 1 where both are
    empty, nan without a mask.

    Args:
        pixels: along a side of the grid that both are brought to: logits interpolated,
            coverage averaged. The
            sensor's pixels tell what a user of the mask sees; without it the grid of
            the logits serves.
    """
    if not logits.numel():
        return torch.full((len(mask),), float("nan"))
    if pixels is not None:
        logits, mask = at_pixels(logits, mask, pixels)
    found, truth = logits > 0, resize_mask(mask, logits) > 0.5
    union = (found | truth).sum((1, 2))
    both = (found & truth).sum((1, 2))
    return torch.where(
        union > 0, both / union.clamp_min(1), torch.ones_like(both, dtype=torch.float32)
    )
