"""A free-form lens from Eq. 6 itself: triplets of rendered eyes through the PSFs of the
phase, and their Fisher matrix.
"""

import torch
from torch import Tensor

from codesign.evaluate.optics import SensitivityScenes, scene_views
from codesign.eye import states_at
from metalens.design.free_form import DesignScore, ResolvedFisherSettings
from metalens.image import (
    Grid,
    OpticsLoss,
    Pupil,
    encircled_energy,
    optics_loss,
    uniform_imager,
)
from metalens.image import pupil as pupils
from metalens.psf import integrate_pixels

DEPTHS = 14  # of the PSF stack, at equal steps of 1/z over what the scenes hold


class SceneObjective:
    """Eq. 6 of a phase on the pupil, over a fixed set of scenes."""

    def __init__(
        self,
        pupil: Pupil,
        settings: ResolvedFisherSettings,
        scenes: SensitivityScenes | None = None,
    ) -> None:
        """Render the triplets once.

        Args:
            scenes: pixels, pitch and steps; by default 128 pixels of 9 um and
                ``settings.scenes`` scenes.
        """
        self.pupil, self.settings = pupil, settings
        self.scenes = scenes or SensitivityScenes(
            count=settings.scenes, pitch_um=9.0, pixels=128, window_um=153.0
        )
        states = states_at(torch.arange(self.scenes.count), 100 + settings.seed)
        views = scene_views(
            states, self.scenes, sensor_distance_um=pupil.sensor_distance_um
        )
        self.frames = [view.frames for view in views]
        seen = torch.cat([f.depth_um[f.coverage > 0] for f in self.frames])
        low, high = float(seen.min()), float(seen.max())
        self.depths_um = 1 / torch.linspace(
            1 / low, 1 / high, DEPTHS, dtype=torch.float64
        )
        self.size = (
            int(min(self.scenes.window_um, pupil.period_um) / self.scenes.pitch_um)
            // 2
            * 2
            - 1
        )
        self.grid = Grid(
            (self.scenes.pixels, self.scenes.pixels),
            self.scenes.pitch_um,
            (low, high),
            window=self.size,
        )
        sharp = [f.radiance.sum(1) for f in self.frames]
        self.reference = self._fisher(sharp).diagonal().detach()

    def loss(
        self, phase_rad: Tensor, focus_um: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Eq. 6 without its last term, and the encircled energy at every depth (which
        the design holds instead).

        Args:
            phase_rad: (y, x) phase on the nodes of the pupil.
            focus_um: source distance that the phase images onto the sensor.
            generator: of the draws.
        """
        found, energy = self.evaluate(phase_rad, focus_um)
        return found.value, energy

    def judge(self, phase_rad: Tensor, focus_um: float) -> DesignScore:
        """Minus Eq. 6 as the figure to climb.

        Args:
            phase_rad: (y, x) phase on the nodes of the pupil.
            focus_um: source distance that the phase images onto the sensor.
        """
        with torch.no_grad():
            found, energy = self.evaluate(phase_rad, focus_um)
        return DesignScore(-found.value[None], energy)

    def evaluate(self, phase_rad: Tensor, focus_um: float) -> tuple[OpticsLoss, Tensor]:
        """The loss with its parts, and the encircled energy at every depth.

        Args:
            phase_rad: (y, x) phase on the nodes of the pupil.
            focus_um: source distance that the phase images onto the sensor.
        """
        sample = self.settings.sample_um
        samples = min(
            int((self.size + 2) * self.scenes.pitch_um / sample),
            int(self.pupil.period_um / sample),
        )
        fine = pupils.psf(
            phase_rad,
            self.pupil,
            depths_um=self.depths_um,
            focus_um=focus_um,
            sample_um=sample,
            samples=samples,
        )
        energy = encircled_energy(fine, sample, radius_um=self.settings.radius_um)
        stack = integrate_pixels(
            fine, sample, pitch_um=self.scenes.pitch_um, shape=(self.size, self.size)
        )
        optics = uniform_imager(stack, self.depths_um, self.grid)
        images = [optics(frames) for frames in self.frames]
        scale = torch.sqrt(self.reference)
        fisher = self._fisher(images) / torch.outer(scale, scale)
        found = optics_loss(
            fisher, energy, orthogonality=self.settings.orthogonality, compactness=0.0
        )
        return found, energy

    def _fisher(self, images: list[Tensor]) -> Tensor:
        """(2, 2) Fisher matrix of gaze and slip, summed over scenes of one mean."""
        anchor, gaze, slip = (i / images[0].mean((1, 2), keepdim=True) for i in images)
        steps = torch.stack([(gaze - anchor).flatten(), (slip - anchor).flatten()])
        return steps @ steps.mT
