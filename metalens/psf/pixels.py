"""PSFs as a sensor sees them: pixels of any pitch, and binned pixels."""

import math

import torch
from torch import Tensor


def pixel_count(samples: int, sample_um: float, pitch_um: float) -> int:
    """Number of pixels of this pitch that cover ``samples`` samples, at least 1.

    Args:
        sample_um: step of the samples, um.
        pitch_um: lattice constant, um.
    """
    return max(1, math.ceil(samples * sample_um / pitch_um * (1 - 1e-12)))


def whole_pixels(samples: int, sample_um: float, pitch_um: float) -> int:
    """Number of pixels of this pitch that lie wholly inside ``samples`` samples.

    A relative tolerance of 1e-12 allows for rounded lengths.

    Args:
        sample_um: step of the samples, um.
        pitch_um: lattice constant, um.
    """
    return math.floor(samples * sample_um / pitch_um * (1 + 1e-12))


def pixel_weights(
    samples: int,
    sample_um: float,
    *,
    pitch_um: float | Tensor,
    count: int | None = None,
    shift_um: float = 0.0,
    grid_um: float | None = None,
) -> Tensor:
    """(pixels, samples) share of each sample's light that falls on each pixel, float64.

    The cumulative light at the sample edges is interpolated by a Catmull-Rom cubic and
    differenced at the pixel edges. It equals the area overlap where the edges coincide,
    conserves energy, and has a continuous derivative by the pitch. Plain overlap has a
    kink at every pitch at which a pixel edge meets a sample edge.

    Args:
        samples: of the image along this axis; the image is centred on the pixel row.
        sample_um: step of the samples, um.
        pitch_um: float, or a tensor that the weights are differentiable in.
        count: of pixels; by default as many as cover the image.
        shift_um: of the pixel row towards + along the axis.
        grid_um: spacing of the pixels, the pitch by default. With it ``pitch_um`` is
            the width of the box alone (the paper's learnable box filter). Its light is
            scaled to a box of ``grid_um``.

    Accuracy:
        Column sums are 1 to rounding where the pixels reach one sample beyond the
        image. The cubic overshoots: a pixel next to an isolated bright sample has up to
        -0.075 of it, but none on sampled PSFs.
    """
    pitch = torch.as_tensor(pitch_um, dtype=torch.float64)
    pixels = pixel_count(
        samples, sample_um, float(pitch.detach()) if grid_um is None else grid_um
    )
    pixels = pixels if count is None else count
    place = torch.arange(pixels + 1, dtype=torch.float64) - pixels / 2

    def cumulative(edge_um: Tensor) -> Tensor:
        position = (edge_um + shift_um) / sample_um + samples / 2
        return _smooth_step(
            position[:, None] - torch.arange(samples, dtype=torch.float64)
        )

    if grid_um is None:
        edges = cumulative(place * pitch)
        return edges[1:] - edges[:-1]
    centres = (place[:-1] + 0.5) * grid_um
    return (cumulative(centres + pitch / 2) - cumulative(centres - pitch / 2)) * (
        grid_um / pitch
    )


def integrate_pixels(
    image: Tensor,
    sample_um: float,
    *,
    pitch_um: float | Tensor,
    shape: tuple[int, int] | None = None,
    shift_um: tuple[float, float] = (0.0, 0.0),
    grid_um: float | None = None,
) -> Tensor:
    """Light on every pixel: the sum of ``image`` over the pixel's area.

    Args:
        image: (..., y, x) light per sample.
        sample_um: step of the samples, um.
        pitch_um: of the pixels, um, a number or a tensor.
        shape: (rows, columns) of pixels; by default as many as cover the image.
        shift_um: (y, x) of the pixel grid.
        grid_um: see :func:`pixel_weights`.

    Returns:
        (..., rows, columns) in the dtype of ``image``; differentiable in image and
        pitch.
    """
    counts = (None, None) if shape is None else shape
    rows, columns = (
        pixel_weights(
            n,
            sample_um,
            pitch_um=pitch_um,
            count=count,
            shift_um=shift,
            grid_um=grid_um,
        )
        for n, count, shift in zip(image.shape[-2:], counts, shift_um, strict=True)
    )
    return rows.to(image) @ image @ columns.to(image).mT


def _smooth_step(t: Tensor) -> Tensor:
    """Cumulative light at t of a cell [0, 1] of unit light, by a Catmull-Rom cubic.

    It is 0 for t < -1 and 1 for t > 2.
    """
    u = t + 1
    w = t - 1
    before = 0.5 * u**2 * (u - 1)
    inside = t * (0.5 + t * (1.5 - t))
    after = 1 + 0.5 * w * (1 - w) ** 2
    # exactly one piece at each t, so that its slope counts once
    left = torch.where(t < 0, torch.where(t < -1, 0.0, before), inside)
    return torch.where(t < 1, left, torch.where(t < 2, after, 1.0))
