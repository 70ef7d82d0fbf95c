"""Optics losses: separability of gaze and slippage (Eqs. 4 to 6), or depth
information of blurred texture.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from codesign.batches import EyeScenes
from codesign.eye import moved_states, render
from codesign.optics import OpticsConfig, PixelPsfStack
from codesign.settings import LARGEST, LEAST, check_ranges
from metalens.image import (
    Frames,
    OpticsLoss,
    Sensor,
    encircled_energy,
    optics_loss,
    texture_information,
)
from metalens.image import sensor as camera

Motions = Literal["axial", "all"]


@dataclass(frozen=True, slots=True)
class SeparabilityConfig:
    """Eq. 6 in training.

    every: steps from one evaluation to the next; 0 leaves the loss out.
    triplets: anchors of an evaluation.
    motions: "axial", gaze across and slippage along the axis (2 x 2); "all", gaze
    across and slippage in all directions (4 x 4).
    gaze_step_deg, slip_step_um: of the differences, in the linear regime of the image.
    orthogonality, compactness: weights of the second and third term of Eq. 6.
    """

    every: int = 0
    triplets: int = 4
    motions: Motions = "axial"
    gaze_step_deg: float = 0.1
    slip_step_um: float = 50.0
    orthogonality: float = 1.0
    compactness: float = 1.0

    def __post_init__(self) -> None:
        above_0, not_below_0 = (LEAST, LARGEST), (0, LARGEST)
        check_ranges(
            self,
            every=not_below_0,
            triplets=(1, LARGEST),
            gaze_step_deg=above_0,
            slip_step_um=above_0,
            orthogonality=not_below_0,
            compactness=not_below_0,
        )

    @property
    def directions(self) -> tuple[tuple[str, int, float], ...]:
        """(field of the state, axis, step in rad or um) of every motion, gaze first."""
        gaze = ("gaze_rad", 0, math.radians(self.gaze_step_deg))
        slips = (2,) if self.motions == "axial" else (0, 1, 2)
        return (gaze, *(("slip_um", axis, self.slip_step_um) for axis in slips))

    @property
    def units(self) -> tuple[float, ...]:
        """Step of every motion in degrees or mm: the units of the Fisher matrix."""
        _, *slips = self.directions
        return (self.gaze_step_deg, *(1e-3 * step for _, _, step in slips))


@dataclass(frozen=True, eq=False, slots=True)
class FisherSeparability:
    """Fisher matrix of gaze and slippage at the sensor, and the loss of Eq. 6.

    fisher: (motions, motions), mean over the anchors, per degree and mm.
    """

    fisher: Tensor
    loss: OpticsLoss

    @property
    def angle_rad(self) -> Tensor:
        """Span angle of Eq. 5 between gaze and axial slippage, in [0, pi].

        atan2(sqrt(F_gg F_zz - F_gz²), F_gz): accurate near 0 and pi.
        """
        gaze, slip, cross = (self.fisher[i, j] for i, j in ((0, 0), (-1, -1), (0, -1)))
        return torch.atan2((gaze * slip - cross**2).clamp_min(0).sqrt(), cross)


def triplet_frames(
    scenes: EyeScenes, config: SeparabilityConfig, step: int
) -> list[Frames]:
    """Frames of the anchors of a training step, then of every motion of them.

    All at the anchors' exposure.

    Args:
        scenes: frames by number. config: motions, steps and weights of Eq. 6.
        step: number of the training step.
    """
    # no other frames are drawn from this stream
    anchors = replace(scenes, stream=4).states(step, config.triplets)
    return [
        render(states, rig=scenes.rig, camera=scenes.camera, exposed=anchors).frames
        for states in moved_states(anchors, config.directions)
    ]


def fisher_separability(
    frames: list[Frames],
    image: Callable[[Frames], Tensor],
    encircled: Tensor,
    config: SeparabilityConfig,
    *,
    sensor: Sensor,
    sample_um: float,
) -> FisherSeparability:
    """Fisher matrix and loss of Eqs. 4 to 6 for a lens and its sensor; differentiable.

    F = J J^T / anchors, where J holds finite differences of the expected electrons over
    their mean, per degree or mm.

    Args:
        frames: of :func:`triplet_frames`.
        image: returns the irradiance (n, y, x) of frames on samples ``sample_um``
            apart.
        encircled: encircled energy of the lens, any shape.
        config: motions, steps and weights of Eq. 6.
        sensor: its pixels; noise is left out. sample_um: spacing of the samples.
    """
    anchor, *moved = (
        camera.mean_electrons(image(f), sample_um, sensor=sensor) for f in frames
    )
    mean_level = anchor.mean((-2, -1), keepdim=True)
    derivatives = [
        (electrons - anchor) / (mean_level * unit)
        for electrons, unit in zip(moved, config.units, strict=True)
    ]
    jacobian = torch.stack(derivatives).flatten(1)
    fisher = jacobian @ jacobian.mT / len(anchor)
    loss = optics_loss(
        fisher,
        encircled.to(fisher),
        orthogonality=config.orthogonality,
        compactness=config.compactness,
    )
    return FisherSeparability(fisher, loss)


def depth_information(stack: PixelPsfStack) -> Tensor:
    """(depths - 1,) Fisher information on depth between neighbouring depths, per mm².

    From the blur of a window of 1/f texture as wide as the PSFs, with noise of a
    thousandth of the texture's mean power. One over its square root is the Cramér-Rao
    bound of a reader that knows only the statistics of the texture
    (:func:`metalens.fisher.texture_information`).

    Args:
        stack: PSFs over depth.
    """
    psfs = stack.intensity
    spectrum = _texture(psfs.shape[-1]).to(psfs)
    pairs = torch.stack([psfs[:-1], psfs[1:]], 1)
    return torch.stack(
        [
            texture_information(
                pair, step_um=float(gap), spectrum=spectrum, noise=1e-3
            )[0]
            for pair, gap in zip(pairs, stack.depths_um.diff(), strict=True)
        ]
    )


def texture_depth_loss(
    stack: PixelPsfStack, settings: OpticsConfig, *, energy: float
) -> Tensor:
    """Mean of -log(information on depth + 0.05), plus a hinge on the encircled energy.

    Replaces Eq. 6 of the paper: the network reads the blur of texture, and the
    information of the PSF alone ranks lenses wrongly.

    Args:
        stack: PSFs over depth. settings: of the lens and its image.
        energy: least encircled energy within two samples.
    """
    information = depth_information(stack)
    share = encircled_energy(
        stack.intensity, settings.sample_um, radius_um=2 * settings.sample_um
    )
    return 50 * torch.relu(energy - share).mean() - torch.log(information + 0.05).mean()


def _texture(size: int) -> Tensor:
    """Power of a 1/f texture on the grid of rfft2, of mean 1."""
    fy, fx = torch.fft.fftfreq(size), torch.fft.rfftfreq(size)
    power = 1 / (fy[:, None] ** 2 + fx**2 + (0.5 / size) ** 2)
    return torch.as_tensor(power / power.mean())
