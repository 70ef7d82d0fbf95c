"""Images of the lens for each training step, cached while it is fixed, and the
sensor frames of them.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.batches import parallel
from codesign.optics import (
    DrawnLensErrors,
    OpticsConfig,
    PixelPsfStack,
    image_formation,
)
from metalens.image import Imager, Sensor, draw_nodes
from metalens.image import sensor as camera
from metalens.psf import pixel_count

Draw = Callable[[int], DrawnLensErrors | None]


@dataclass(eq=False)
class StepImaging:
    """Imager of the frames of every step: kept while the lens is fixed, renewed as it
    moves.

    The uniform image is formed at every step in which the lens moves. The true image is
    formed every ``refresh`` steps and when the lens stops. Between these it is that of
    the last time, while the gradient is that of the present lens (see
    :mod:`codesign.optics.image_formation`).

    stacks: PSFs of a lens that is made, one of them a step. draw: error of a made lens,
    by step.
    """

    optics: OpticsConfig
    stacks: Sequence[PixelPsfStack]
    _: KW_ONLY
    refresh: int
    draws: int
    seed: int
    draw: Draw

    def __post_init__(self) -> None:
        self.imaged_step = -1
        self.imaged_rad = torch.zeros(0, dtype=torch.float64)
        # of images and losses: see :func:`codesign.train.place_on_device`
        self.device = torch.device("cpu")
        self._ready: Imager | None = None
        self._given: dict[int, Imager] = {}
        self._live: image_formation.DifferentiableImager | None = None

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
        """Imager of a step for square frames; differentiable where ``live``.

        Args:
            step: its number. coefficients_rad: (polynomials,) of the lens, rad.
            frame: samples along a side, margin included. margin: samples around the
                frame.
            live: the lens moves: the gradient goes through ``draws`` random field
                points and wavelengths.
        """
        self._live = None
        make = functools.partial(
            image_formation.make_imager,
            self.optics,
            frame=frame,
            margin=margin,
            device=self.device,
        )
        if self.stacks:
            return self._drawn(step, coefficients_rad, make)
        if self.optics.image == "uniform":
            return self._uniform(step, coefficients_rad, make, live=live)
        imager = self._true(step, coefficients_rad.detach(), make, live=live)
        if not live:
            return imager
        generator = seeded_generator(self.seed, step, 9)
        nodes = draw_nodes(imager.plan, self.draws, generator)
        self._live = image_formation.make_differentiable_imager(
            self.optics, imager, nodes
        )
        return self._live.ready

    def pass_on(self, coefficients_rad: Tensor) -> None:
        """Backward pass from the image to the coefficients, after that of the loss.

        The loss's own stops at the light of the drawn nodes. Nothing where the lens is
        fixed.

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
        make: Callable[..., Imager],
        *,
        live: bool,
    ) -> Imager:
        """Imager with one PSF a depth, cached while the lens is fixed and no error
        is drawn.
        """
        error = self.draw(step)
        if not live and error is None and self._ready is not None:
            return self._ready
        imager = make(coefficients_rad=coefficients_rad, error=error, shared=True)
        self._ready = None if live or error is not None else imager
        return imager

    def _true(
        self,
        step: int,
        coefficients_rad: Tensor,
        make: Callable[..., Imager],
        *,
        live: bool,
    ) -> Imager:
        """True image of the lens, cached.

        Formed anew at the first step, when a moving lens stops, and every ``refresh``
        steps if the lens moved or its error is drawn.
        """
        is_first = self.imaged_step < 0
        moved = not torch.equal(coefficients_rad, self.imaged_rad)
        has_error = not is_first and self.draw(self.imaged_step) is not None
        is_due = step - self.imaged_step >= self.refresh
        if is_first or (moved and not live) or ((moved or has_error) and is_due):
            self.imaged_step, self.imaged_rad = step, coefficients_rad.clone()
            self._ready = None
        if self._ready is None:
            error = self.draw(self.imaged_step)
            self._ready = make(coefficients_rad=self.imaged_rad, error=error)
        return self._ready

    def _drawn(
        self, step: int, coefficients_rad: Tensor, make: Callable[..., Imager]
    ) -> Imager:
        """Imager of the PSF stack that this step draws; each is formed once."""
        generator = np.random.default_rng([self.seed, step, 4])
        number = int(generator.integers(len(self.stacks)))
        if number not in self._given:
            stack = self.stacks[number]
            self._given[number] = make(coefficients_rad=coefficients_rad, made=stack)
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
    """(batch, 1, rows, columns) standardised sensor frames: pixels, noise,
    quantisation.

    Mean 0 and variance 1 of every frame. The gradient in the pitch is that of a network
    of fixed cost, whose own grid stays on the scene: the box of the pixels widens, and
    an area is read (pitch0 / pitch)² times, while its light and photon noise stay. The
    gradient of the zoom itself is left out: it says nothing of the next number of
    pixels.

    Args:
        irradiance: (batch, y, x) light on the image grid.
        sample_um: spacing of the samples. pitch_um: () pitch of the pixels, um.
        sensor: its noise, full well and quantisation. generator: of the draws.
        exact: Poisson counts; otherwise their normal approximation, four times faster
            (without the skewness 1 / sqrt(mean)), still Poisson where the mean is below
            20 electrons.
        resized: the frames will be averaged to a coarser grid, whose cells, not the
            pixels, are then the box: the gradient in the pitch is that of the reads
            alone.
        quiet: the expected electrons, without noise.
    """
    pitch = float(pitch_um.detach())
    pixel = replace(sensor, pitch_um=pitch)  # the full well is that of this pitch
    box = pitch_um.detach()
    grid_um = None
    if pitch_um.requires_grad and not resized:
        box = pitch_um
        grid_um = pitch
    mean = camera.mean_electrons(
        irradiance, sample_um, sensor=pixel, pitch_um=box, grid_um=grid_um
    )
    reads = (pitch / pitch_um) ** 2
    if quiet:
        electrons = mean.clamp(
            max=pixel.full_well_e * float(camera.kappa(pitch, pixel.base_pitch_um))
        )
    elif not exact and float(mean.detach().mean()) > 20:
        electrons = _normal(mean, pixel, generator, reads)
    else:
        electrons = camera.expose(mean, sensor=pixel, generator=generator, reads=reads)
    frames = camera.digitise(electrons, sensor=pixel)
    centred = frames - frames.mean((-2, -1), keepdim=True)
    count = centred.shape[-2] * centred.shape[-1]
    variance = (centred * centred).sum((-2, -1), keepdim=True) / max(count - 1, 1)
    deviation = variance.clamp_min(1e-12).sqrt()
    return (centred / deviation)[:, None].to(torch.float32)


def _normal(
    mean: Tensor, sensor: Sensor, generator: torch.Generator | None, reads: Tensor
) -> Tensor:
    """Electrons drawn from a normal distribution of the mean and variance of the
    exposure.

    Mean clipped to the full well, variance mean + read noise² * reads, as
    :func:`metalens.image.expose`.
    """
    well = sensor.well_e
    collected = mean.clamp(max=well)
    # noise of the whole batch, of which every process takes its own frames
    size = len(mean)
    total = parallel.process_count() * size
    noise = camera.normal((total, *mean.shape[1:]), mean, generator)
    noise = noise[parallel.process_rank() * size : (parallel.process_rank() + 1) * size]
    return collected + noise * torch.sqrt(
        collected + sensor.read_noise_e**2 * reads.to(mean) + 1e-6
    )


def frame_wide(samples: int, sample_um: float, pitch_um: float) -> float:
    """Width of the sensor's frame over that of its image.

    1, or more where the pixels do not divide the image: the last pixels then reach past
    it, by half a pixel at most. Labels are those of the frame
    (:func:`codesign.network.losses.mask_in_frame`).

    Args:
        samples: of the image along a side. sample_um: spacing of the samples.
        pitch_um: of the pixels.
    """
    wide = pixel_count(samples, sample_um, pitch_um) * pitch_um / (samples * sample_um)
    return 1.0 if abs(wide - 1) < 1e-9 else wide
