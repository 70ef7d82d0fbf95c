"""The images of a training's lens: kept while it stands, formed anew where it moved;
given PSFs in its place.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.optics import LensError, OpticsConfig, PixelPsfStack, formed
from codesign.optics import stack as lens
from metalens.image import Imager, draw_nodes

Draw = Callable[[int], LensError | None]


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
        )  # of images and losses: see :mod:`codesign.train.placement`
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
        if self.stacks:
            return self._drawn(step, coefficients_rad, frame, margin)
        if self.optics.image == "uniform":
            return self._uniform(step, coefficients_rad, frame, margin, live=live)
        made = self._true(step, coefficients_rad.detach(), frame, margin, live=live)
        if not live:
            return made
        self._live = formed.make_differentiable_imager(
            self.optics, made, draw_nodes(made.plan, self.draws, self._generator(step))
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

    def _generator(self, step: int) -> torch.Generator:
        """Of the field points and wavelengths that pass the gradient of a step on."""
        seed = int(
            np.random.SeedSequence([self.seed, step, 9]).generate_state(1, np.uint64)[0]
        )
        return torch.Generator().manual_seed(seed >> 1)

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
        frame: int,
        margin: int,
        *,
        live: bool,
    ) -> Imager:
        first = self.imaged_step < 0
        moved = not torch.equal(coefficients_rad, self.imaged_rad)
        drawn = not first and self.draw(self.imaged_step) is not None
        waited = step - self.imaged_step >= self.refresh
        if first or (moved and not live) or ((moved or drawn) and waited):
            self.imaged_step, self.imaged_rad, self._ready = (
                step,
                coefficients_rad.clone(),
                None,
            )
        if not isinstance(self._ready, Imager):
            error = self.draw(self.imaged_step)
            about: dict[str, Any] = {
                "margin": margin,
                "error": error,
                "device": self.device,
            }
            self._ready = formed.make_imager(
                self.optics, self.imaged_rad, frame, **about
            )
        if not isinstance(self._ready, Imager):
            raise TypeError("the true image needs a field of PSFs")
        return self._ready

    def _drawn(
        self, step: int, coefficients_rad: Tensor, frame: int, margin: int
    ) -> Imager:
        """The given PSFs that this step draws."""
        number = int(
            np.random.default_rng([self.seed, step, 4]).integers(len(self.stacks))
        )
        if number not in self._given:
            made = self.stacks[number]
            about: dict[str, Any] = {
                "margin": margin,
                "made": made,
                "device": self.device,
            }
            self._given[number] = formed.make_imager(
                self.optics, coefficients_rad, frame, **about
            )
        return self._given[number]
