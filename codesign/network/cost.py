"""Multiply-accumulates of a network as a function of architecture and pixel pitch
(paper Eq. 9).
"""

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from codesign.network import blur
from codesign.network.architecture import (
    Architecture,
    BlockSpec,
    SearchSpace,
    active_blocks,
    stem_channels,
)
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError

LEAST_SIZE = 16  # pixels along the edge of an input
# widths of the heads; the networks and the count share them
MASK_CHANNELS, SLIP_CHANNELS, SLIP_GRID, SLIP_HIDDEN = 24, 16, 8, 64
POINTS = 10  # landmarks of the eye, and the pupil's centre
POINT_FEATURES = 3 * POINTS  # their coordinates, and the widths of their maps


@dataclass(frozen=True, slots=True)
class MacPolynomial:
    """Multiply-accumulates as a polynomial of the sizes of the feature maps.

    per_pixel: {total stride: multiply-accumulates per output pixel at that stride}.
    constant: of layers whose size does not follow the image.
    blur: whether the branch of :mod:`codesign.network.blur` is counted too.
    """

    per_pixel: dict[int, int]
    constant: int
    blur: bool = False

    def at(self, size: int | Array) -> Array:
        """Exact count for square inputs of ``size`` pixels (integers)."""
        size = np.asarray(size)
        parts = [
            macs * (-(-size // stride)) ** 2 for stride, macs in self.per_pixel.items()
        ]
        if self.blur:
            parts.append(np.vectorize(blur.blur_branch_macs, otypes=[np.int64])(size))
        return np.asarray(sum(parts) + self.constant)


def backbone_cost(
    stem: int, rows: Iterable[BlockSpec], *, inputs: int = 1, stem_kernel: int = 3
) -> MacPolynomial:
    """Multiply-accumulates of a stem of stride 2 and the blocks after it, by stride.

    The squeeze-and-excitation layers do not depend on the image size.

    Args:
        stem: channels of the stem. rows: blocks in order. inputs: channels of the
            input.
        stem_kernel: side of the stem's kernel.
    """
    per_pixel = {2: inputs * stem * stem_kernel**2}
    constant = 0
    stride = 2
    for block in rows:
        if block.hidden != block.inputs:
            per_pixel[stride] = per_pixel.get(stride, 0) + block.inputs * block.hidden
        stride *= block.stride
        wide = block.hidden * (block.kernel**2 + block.outputs)
        per_pixel[stride] = per_pixel.get(stride, 0) + wide
        constant += 2 * block.hidden * block.squeeze
    return MacPolynomial(per_pixel, constant)


@functools.lru_cache(maxsize=1024)
def network_cost(space: SearchSpace, architecture: Architecture) -> MacPolynomial:
    """Multiply-accumulates of backbone, blur branch, perception and calibration head.

    Args:
        space: architectures to choose from. architecture: member of the search space.
    """
    rows = active_blocks(space, architecture)
    body = backbone_cost(
        stem_channels(space, architecture), [b for row in rows for b in row]
    )
    per_pixel = dict(body.per_pixel)
    laterals = lateral_strides(space)
    for stage, stride in laterals:
        per_pixel[stride] = (
            per_pixel.get(stride, 0) + rows[stage][-1].outputs * MASK_CHANNELS
        )
    finest = laterals[0][1]
    # depthwise 3x3, then the mask itself and the landmarks
    per_pixel[finest] += MASK_CHANNELS * (9 + 1 + POINTS)
    per_pixel[laterals[-1][1]] += rows[-1][-1].outputs * SLIP_CHANNELS
    features = SLIP_CHANNELS * SLIP_GRID**2 + blur.SLIP_FEATURES + POINT_FEATURES
    heads = features * SLIP_HIDDEN + SLIP_HIDDEN * ((3 + 2) * SLIP_HIDDEN + 3 * 3)
    heads += blur.content_macs(MASK_CHANNELS)
    return MacPolynomial(per_pixel, body.constant + heads, blur=True)


def lateral_strides(space: SearchSpace) -> list[tuple[int, int]]:
    """(stage, total stride) of the features that the mask is decoded from.

    The last stage of every stride, from fine to coarse.

    Args:
        space: architectures to choose from.
    """
    stride, last = 2, {}
    for i, stage in enumerate(space.stages):
        stride *= stage.stride
        last[stride] = i
    return [(stage, stride) for stride, stage in last.items()]


def input_size(window_um: float, pitch_um: float, resolution: float) -> float:
    """Pixels along the edge of the network's input: window / pitch * resolution.

    Args:
        window_um: side of the image. pitch_um: of the pixels.
        resolution: scale of the input, in (0, 1].

    Raises:
        ConfigError: less than 16 pixels remain.
    """
    size = window_um / pitch_um * resolution
    if size < LEAST_SIZE:
        raise ConfigError(
            f"pitch {pitch_um} um leaves {size:.1f} pixels of a {window_um} um window, need {LEAST_SIZE} or more"
        )
    return size


def coarsest_um(window_um: float, resolution: float) -> float:
    """Largest pitch that :func:`input_size` takes.

    Args:
        window_um: edge of the image.
        resolution: pixels that the network keeps, of the sensor's along a side.
    """
    return window_um * resolution / LEAST_SIZE


def macs_of_size(
    space: SearchSpace, architecture: Architecture, size: Tensor | float
) -> Tensor:
    """Multiply-accumulates at a continuous input size, differentiable.

    Monotone cubic interpolation of the counts at integers (Fritsch and Carlson 1980)
    with its derivative: exact at integers, never decreasing, and of zero gradient
    between equal counts.

    Args:
        size: pixels along the edge of the input, 16 or more, scalar.
        space: architectures to choose from. architecture: member of the search space.
    """
    size = torch.as_tensor(size, dtype=torch.float64)
    value = float(size.detach())
    integers = math.floor(value) + np.arange(-1, 3)
    count = PchipInterpolator(integers, network_cost(space, architecture).at(integers))
    return float(count(value)) + float(count(value, 1)) * (size - value)


@functools.lru_cache(maxsize=4096)
def count_macs(space: SearchSpace, architecture: Architecture, size: float) -> float:
    """:func:`macs_of_size` as a number, cached: training asks for the same every step.

    Args:
        space: architectures to choose from. architecture: member of the search space.
        size: pixels along the edge of the input.
    """
    return float(macs_of_size(space, architecture, size))


def macs(
    architecture: Architecture,
    pitch_um: Tensor | float,
    *,
    window_um: float,
    space: SearchSpace | None = None,
) -> Tensor:
    """Multiply-accumulates C_total of one inference at a pixel pitch (paper Eq. 9).

    Differentiable in the pitch.

    Args:
        architecture: member of the search space.
        pitch_um: effective pixel pitch, scalar.
        window_um: side of the square image on the sensor.
        space: architectures to choose from; the default space without it.

    Raises:
        ConfigError: a pitch that leaves less than 16 pixels.
    """
    input_size(
        window_um, float(torch.as_tensor(pitch_um).detach()), architecture.resolution
    )
    size = window_um / pitch_um * architecture.resolution
    return macs_of_size(space or SearchSpace(), architecture, size)
