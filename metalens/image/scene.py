"""Scenes of two sheets, each a surface of varying depth (paper Sec. 3.1)."""

from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from torch import Tensor
from torch.autograd import forward_ad

from metalens.core.errors import SceneError


class DeviceRecord:
    """A dataclass of tensors and of such records."""

    __slots__ = ()

    def to(self, device: torch.device | str) -> Self:
        """The same with its tensors on a device."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        moved = {k: v.to(device) for k, v in values.items() if hasattr(v, "to")}
        return replace(self, **moved)  # type: ignore[type-var]


@dataclass(frozen=True, eq=False, slots=True)
class Frames(DeviceRecord):
    """Rendered sheets, index 0 near and 1 far along the axis of sheets.

    radiance: (frames, 2, y, x), already multiplied by the coverage.
    coverage: (frames, 2, y, x) in [0, 1]; the two add up to 1 where the scene is
    opaque.
    depth_um: (frames, 2, y, x) distance from the lens plane; any value where the
    coverage is 0.
    """

    radiance: Tensor
    coverage: Tensor
    depth_um: Tensor

    def __post_init__(self) -> None:
        shape = self.radiance.shape
        if (
            len(shape) != 4
            or shape[1] != 2
            or self.coverage.shape != shape
            or self.depth_um.shape != shape
        ):
            shapes = [
                tuple(a.shape) for a in (self.radiance, self.coverage, self.depth_um)
            ]
            raise SceneError(
                f"radiance, coverage, depth have shapes {shapes}, need the same (frames, 2, y, x)"
            )


def is_plain_value(a: Tensor) -> bool:
    """Whether a tensor lies in main memory and carries no gradient of either mode.

    Args:
        a: a tensor.
    """
    return a.device.type == "cpu" and has_no_gradient(a)


def has_no_gradient(a: Tensor) -> bool:
    """Whether a tensor carries no gradient, of reverse or of forward mode.

    Args:
        a: a tensor.
    """
    return not a.requires_grad and forward_ad.unpack_dual(a).tangent is None  # type: ignore[no-untyped-call]
