"""What a network sees of a step: the images of the lens, kept while it stands and
formed anew where it moved, and their frames on the sensor.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.batches import parallel
from codesign.optics import DrawnLensErrors, OpticsConfig, PixelPsfStack, formed
from codesign.optics import stack as lens
from metalens.image import Imager, Sensor, draw_nodes
from metalens.image import sensor as camera
from metalens.psf import pixel_count

Draw = Callable[[int], DrawnLensErrors | None]


class StepImaging:
    """What images the frames of every step.

    One PSF a depth is formed at every step in which the lens moves. The true image is
    formed anew every ``refresh``
    steps and when the lens comes to rest: within a step its lens is that of the last
    time, while the gradient goes to
    the lens as it is (see :mod:`codesign.optics.formed`).
    """

    def __init__(
        self,
        optics: OpticsConfig,
        stacks: Sequence[PixelPsfStack],
        *,
        refresh: int,
        draws: int,
        seed: int,
        draw: Draw,
    ) -> None:
        """``stacks``: PSFs of a lens that is made, one of them a step. ``draw``: error
        of a made lens, by step.
        """
        self.optics, self.stacks, self.draw = optics, tuple(stacks), draw
        self.refresh, self.draws, self.seed = refresh, draws, seed
        self.imaged_step, self.imaged_rad = -1, torch.zeros(0, dtype=torch.float64)
        self.device = torch.device(
            "cpu"
        )  # of images and losses: see :func:`codesign.train.place_on_device`
        self._ready: Imager | None = None
        self._given: dict[int, Imager] = {}
        self._live: formed.DifferentiableImager | None = None

    def state(self) -> dict[str, Any]:
        """Which lens is imaged: all that the next step needs."""
        return {"step": self.imaged_step, "coefficients_rad": self.imaged_rad}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what :meth:`state` gave."""
        self.imaged_step, self.imaged_rad = state["step"], state["coefficients_rad"]
        self._ready, self._live = None, None

    def at(
        self,
        step: int,
        coefficients_rad: Tensor,
        frame: int,
        margin: int,
        *,
        live: bool,
    ) -> Imager:
        """The imager of a step for frames of ``frame`` samples, margin included;
        ``live``: the lens moves.

        Args:
            coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        """
        self._live = None
        make = functools.partial(
            formed.make_imager,
            self.optics,
            frame=frame,
            margin=margin,
            device=self.device,
        )
        if self.stacks:
            return self._drawn(step, coefficients_rad, make)
        if self.optics.image == "uniform":
            return self._uniform(step, coefficients_rad, frame, margin, live=live)
        made = self._true(step, coefficients_rad.detach(), make, live=live)
        if not live:
            return made
        drawn = seeded_generator(self.seed, step, 9)  # field points and wavelengths
        self._live = formed.make_differentiable_imager(
            self.optics, made, draw_nodes(made.plan, self.draws, drawn)
        )
        return self._live.ready

    def pass_on(self, coefficients_rad: Tensor) -> None:
        """After the loss went backward: its gradient from the light to the
        coefficients, where it stopped there.

        Args:
            coefficients_rad: (polynomials,) phase coefficients of the lens, rad.
        """
        if self._live is not None:
            self._live.pass_on(self.optics, coefficients_rad)
            self._live = None

    def _uniform(
        self,
        step: int,
        coefficients_rad: Tensor,
        frame: int,
        margin: int,
        *,
        live: bool,
    ) -> Imager:
        error = self.draw(step)
        if not live and error is None and self._ready is not None:
            return self._ready
        made = lens.lens_psf_stack(
            self.optics, coefficients_rad, error=error, shared=True
        )
        prepared = lens.stack_imager(self.optics, made, frame, margin=margin).to(
            self.device
        )
        self._ready = None if live or error is not None else prepared
        return prepared

    def _true(
        self,
        step: int,
        coefficients_rad: Tensor,
        make: Callable[..., Imager],
        *,
        live: bool,
    ) -> Imager:
        first = self.imaged_step < 0
        moved = not torch.equal(coefficients_rad, self.imaged_rad)
        drawn = not first and self.draw(self.imaged_step) is not None
        waited = step - self.imaged_step >= self.refresh
        if first or (moved and not live) or ((moved or drawn) and waited):
            self.imaged_step, self.imaged_rad = step, coefficients_rad.clone()
            self._ready = None
        if self._ready is None:
            error = self.draw(self.imaged_step)
            self._ready = make(coefficients_rad=self.imaged_rad, error=error)
        return self._ready

    def _drawn(
        self, step: int, coefficients_rad: Tensor, make: Callable[..., Imager]
    ) -> Imager:
        """The given PSFs that this step draws."""
        generator = np.random.default_rng([self.seed, step, 4])
        number = int(generator.integers(len(self.stacks)))
        if number not in self._given:
            made = self.stacks[number]
            self._given[number] = make(coefficients_rad=coefficients_rad, made=made)
        return self._given[number]


def seeded_generator(seed: int, step: int, stream: int) -> torch.Generator:
    """Random generator of a step of a training.

    Args:
        seed: of the training. step: its number. stream: what is drawn.
    """
    words = np.random.SeedSequence([seed, step, stream]).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(words[0]) >> 1)


def read_out(
    irradiance: Tensor,
    sample_um: float,
    pitch_um: Tensor,
    sensor: Sensor,
    *,
    generator: torch.Generator | None,
    exact: bool = True,
    resized: bool = False,
    quiet: bool = False,
) -> Tensor:
    """(batch, 1, rows, columns) standardised frames as the network sees them: pixels,
    noise, quantisation.

    The gradient in the pitch is that of a network whose own grid stays on the scene, so
    of a fixed cost: the box of the
    pixels widens, and an area of the sensor is read (pitch0 / pitch)^2 times; its light
    and photon noise stay. (The
    frame as such zooms while its pixels grow, until one drops off at the rim: a slope
    that says nothing of the next
    count of pixels.)

    Args:
        exact: Poisson counts; otherwise their normal approximation, four times faster
            (the skewness 1 / sqrt(mean)
            is lost), still Poisson where the mean is below 20 electrons.
        resized: the frames will be averaged to a coarser grid, whose cells, not the
            pixels, are then the box: the
            gradient in the pitch is that of the reads alone.
        quiet: the expected electrons, without noise.
        irradiance: (batch, y, x) light on the image grid.
        sample_um: distance of the samples. pitch_um: () pitch of the pixels, um.
        generator: of the draws.
    """
    here, moves = float(pitch_um.detach()), pitch_um.requires_grad
    pixel = replace(sensor, pitch_um=here)  # the full well is that of this pitch
    box, grid_um = (
        (pitch_um, here) if moves and not resized else (pitch_um.detach(), None)
    )
    mean = camera.mean_electrons(
        irradiance, sample_um, sensor=pixel, pitch_um=box, grid_um=grid_um
    )
    reads = (here / pitch_um) ** 2
    if quiet:
        electrons = mean.clamp(
            max=pixel.full_well_e * float(camera.kappa(here, pixel.base_pitch_um))
        )
    elif not exact and float(mean.detach().mean()) > 20:
        electrons = _normal(mean, pixel, generator, reads)
    else:
        electrons = camera.expose(mean, sensor=pixel, generator=generator, reads=reads)
    frames = camera.digitise(electrons, sensor=pixel)
    centred = frames - frames.mean((-2, -1), keepdim=True)
    count = centred.shape[-2] * centred.shape[-1]
    deviation = (
        ((centred * centred).sum((-2, -1), keepdim=True) / max(count - 1, 1))
        .clamp_min(1e-12)
        .sqrt()
    )
    return (centred / deviation)[:, None].to(torch.float32)


def _normal(
    mean: Tensor, sensor: Sensor, generator: torch.Generator | None, reads: Tensor
) -> Tensor:
    """Electrons of mean and variance as :func:`metalens.image.expose`, up to the full
    well, from one normal draw.
    """
    well = sensor.full_well_e * float(
        camera.kappa(sensor.pitch_um, sensor.base_pitch_um)
    )
    collected = mean.clamp(max=well)
    share, size = (
        parallel.process_count(),
        len(mean),
    )  # the noise of the whole batch, whoever takes which part of it
    noise = camera.normal((share * size, *mean.shape[1:]), mean, generator)
    noise = noise[parallel.process_rank() * size : (parallel.process_rank() + 1) * size]
    return collected + noise * torch.sqrt(
        collected + sensor.read_noise_e**2 * reads.to(mean) + 1e-6
    )


def frame_wide(samples: int, sample_um: float, pitch_um: float) -> float:
    """Width of the sensor's frame over that of its image: 1, or more where the pixels
    do not divide the image.

    The last pixels then reach beyond the image, by half a pixel at most; a network sees
    the frame and tells places in
    it, so its labels are those of the frame
    (:func:`codesign.network.losses.mask_in_frame`).

    Args:
        samples: of the image along a side. sample_um: distance of the samples.
        pitch_um: of the pixels.
    """
    wide = pixel_count(samples, sample_um, pitch_um) * pitch_um / (samples * sample_um)
    return 1.0 if abs(wide - 1) < 1e-9 else wide
