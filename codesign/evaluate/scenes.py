"""Objective of Eq. 6 for free-form lenses: Fisher matrix of rendered eyes, imaged
through the PSFs of the phase.
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

DEPTHS = 14  # depths of the PSF stack, at equal steps of 1/z over those of the scenes


class SceneObjective:
    """Eq. 6 of a phase on the pupil, over a fixed set of scenes."""

    def __init__(
        self,
        pupil: Pupil,
        settings: ResolvedFisherSettings,
        scenes: SensitivityScenes | None = None,
    ) -> None:
        """Render the scenes at anchor, gaze step and slip step.

        Args:
            pupil: grid of the phase.
            settings: of the Fisher objective.
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
        visible_um = torch.cat(
            [frame.depth_um[frame.coverage > 0] for frame in self.frames]
        )
        nearest_um = float(visible_um.min())
        farthest_um = float(visible_um.max())
        self.depths_um = 1 / torch.linspace(
            1 / nearest_um, 1 / farthest_um, DEPTHS, dtype=torch.float64
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
            (nearest_um, farthest_um),
            window=self.size,
        )
        pinhole_images = [frame.radiance.sum(1) for frame in self.frames]
        self.reference = self._fisher(pinhole_images).diagonal().detach()

    def loss(
        self, phase_rad: Tensor, focus_um: float, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """Loss of Eq. 6 without its compactness term, and the encircled energy at every
        depth, which the design constrains instead.

        Args:
            phase_rad: (y, x) phase on the nodes of the pupil.
            focus_um: source distance that the phase images onto the sensor.
            generator: unused, the scenes are fixed.
        """
        loss, energy = self.evaluate(phase_rad, focus_um)
        return loss.value, energy

    def judge(self, phase_rad: Tensor, focus_um: float) -> DesignScore:
        """Score of a design, minus the loss of Eq. 6, and its encircled energy.

        Args:
            phase_rad: (y, x) phase on the nodes of the pupil.
            focus_um: source distance that the phase images onto the sensor.
        """
        with torch.no_grad():
            loss, energy = self.evaluate(phase_rad, focus_um)
        return DesignScore(-loss.value[None], energy)

    def evaluate(self, phase_rad: Tensor, focus_um: float) -> tuple[OpticsLoss, Tensor]:
        """Loss of Eq. 6 with its parts, and the encircled energy at every depth.

        The Fisher matrix is that of the images, scaled by its diagonal for an ideal
        pinhole image.

        Args:
            phase_rad: (y, x) phase on the nodes of the pupil.
            focus_um: source distance that the phase images onto the sensor.
        """
        sample_um = self.settings.sample_um
        samples = min(
            int((self.size + 2) * self.scenes.pitch_um / sample_um),
            int(self.pupil.period_um / sample_um),
        )
        fine = pupils.psf(
            phase_rad,
            self.pupil,
            depths_um=self.depths_um,
            focus_um=focus_um,
            sample_um=sample_um,
            samples=samples,
        )
        energy = encircled_energy(fine, sample_um, radius_um=self.settings.radius_um)
        stack = integrate_pixels(
            fine, sample_um, pitch_um=self.scenes.pitch_um, shape=(self.size, self.size)
        )
        optics = uniform_imager(stack, self.depths_um, self.grid)
        images = [optics(frames) for frames in self.frames]
        scale = torch.sqrt(self.reference)
        fisher = self._fisher(images) / torch.outer(scale, scale)
        loss = optics_loss(
            fisher, energy, orthogonality=self.settings.orthogonality, compactness=0.0
        )
        return loss, energy

    def _fisher(self, images: list[Tensor]) -> Tensor:
        """(2, 2) Fisher matrix of gaze and slip: products of the image changes, summed
        over pixels and scenes; images are scaled to the mean of the anchor.
        """
        anchor, gaze, slip = (
            image / images[0].mean((1, 2), keepdim=True) for image in images
        )
        steps = torch.stack([(gaze - anchor).flatten(), (slip - anchor).flatten()])
        return steps @ steps.mT
