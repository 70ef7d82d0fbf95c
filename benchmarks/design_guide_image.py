"""The true image of a part of the field, and the rungs below it: PSFs held along one or
both axes of the field.

angle   every window sees the PSFs of the middle of the field: one field angle
line    the PSFs vary along x as they do in the whole field, and are those of the middle row everywhere
whole   the true image
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.evaluate.reader_lens import Forms
from codesign.optics import formed
from codesign.optics.stack import OpticsConfig
from metalens.image import Grid, Imager, imager

# share of the field that a held axis keeps: a micrometre, over which no PSF changes
HELD = 1e-3


@dataclass(frozen=True)
class Narrow(Grid):
    """A grid whose field angles span shares (y, x) of what its samples span; all else
    is the grid's.
    """

    share: tuple[float, float] = (1.0, 1.0)

    @property
    def half_um(self) -> list[float]:
        """[y, x] from the middle of the field to its end."""
        return [
            (n - 1) / 2 * self.step_um * share
            for n, share in zip(self.frame, self.share, strict=True)
        ]


def forms(share: tuple[float, float]) -> Forms:
    """What images with these shares of the field."""
    if share == (1.0, 1.0):
        return formed.imager

    @torch.no_grad()
    def narrow(
        settings: OpticsConfig, coefficients_rad: Tensor, frame: int, *, margin: int
    ) -> Imager:
        plane, grid = (
            formed.optics_of(settings, coefficients_rad),
            formed.grid_of(settings, frame, margin),
        )
        held = Narrow(
            grid.samples, grid.step_um, grid.depths_um, grid.margin, grid.window, share
        )
        return imager(
            plane.wave,
            held,
            spectrum=formed.source_of(settings),
            layers=plane.layers,
            field=(math.radians(settings.angle_deg), 0.0),
            tolerance=settings.image_tolerance,
            distance_um=plane.distance_um,
        )

    return narrow
