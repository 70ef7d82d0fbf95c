"""Lenses compared as in the paper: Tables 1 and 3, Figs. 5 and 7, with intervals."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.eye import CameraRig, EyeStates, PinholeCamera, moved_states, render
from codesign.settings import LARGEST, LEAST, check_ranges
from codesign.train import bootstrap_ratio
from metalens.core.errors import ConfigError, SceneError
from metalens.core.report import Table, figure_png, make_figure
from metalens.image import Frames, Grid, Normalisation, axial_information, imager
from metalens.lens import Lens, reach
from metalens.psf import View, from_lens, passed_um2

KINDS = ("gaze", "slip", "separability")


@dataclass(frozen=True, slots=True)
class MeasurementSettings:
    """How lenses are measured.

    depths_mm, count: of I(z); left out, the depths over which the first lens goes from
    1.75 waves out of focus at the
        rim to as many on the other side.
    angles_deg: field angles. pixel_um, binnings: pixels; left out, pixels of 0.88
    wavelength / NA of the first lens.
    normalisation: of Eq. 11.
    window_um, sample_um: of the PSFs; light outside the window counts as lost. Left
    out, 56.4 wavelength / NA of the
        first lens or 8 radii of its blur, and what shows its finest detail.
    radius_um: of the encircled energy; left out, 5.3 wavelength / NA. step_um: of the
    depth in the difference of Eq. 11; left out, by the lens. tolerance: of the PSF
    engine.
    """

    depths_mm: tuple[float, float] = (0.0, 0.0)
    count: int = 11
    angles_deg: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    pixel_um: float = 0.0
    binnings: tuple[int, ...] = (1, 2, 3)
    normalisation: Normalisation = "l2"
    window_um: float = 0.0
    sample_um: float = 0.0
    radius_um: float = 0.0
    step_um: float = 0.0
    tolerance: float = field(default=1e-3, metadata={"above": 0})

    def __post_init__(self) -> None:
        low, high = self.depths_mm
        if not (low <= high and self.angles_deg and self.binnings):
            raise ConfigError(
                f"depths_mm = {self.depths_mm}, angles_deg = {self.angles_deg}, binnings = {self.binnings}: need the "
                "nearest depth first, and at least one angle and binning"
            )
        lengths = (
            "depths_mm",
            "pixel_um",
            "window_um",
            "sample_um",
            "radius_um",
            "step_um",
        )
        check_ranges(self, **dict.fromkeys(lengths, (0, LARGEST)))
        check_ranges(self, count=(1, LARGEST), binnings=(1, LARGEST))

    def about(self, lens: Lens) -> "MeasurementSettings":
        """These settings with the defaults of a lens for what is left out."""
        nearest_um, farthest_um = (
            (1e3 * z for z in self.depths_mm)
            if any(self.depths_mm)
            else reach.depth_range_um(lens)
        )
        pixel_um = self.pixel_um or reach.pixel_um(lens)
        sample_um = self.sample_um or reach.sample_um(
            lens, pixel_um * min(self.binnings)
        )
        window_um = self.window_um or reach.window_um(
            lens, (nearest_um, farthest_um), airy=56.4
        )
        return replace(
            self,
            pixel_um=pixel_um,
            depths_mm=(nearest_um * 1e-3, farthest_um * 1e-3),
            radius_um=self.radius_um or reach.disc_um(lens),
            sample_um=sample_um,
            window_um=max(4, round(window_um / sample_um)) * sample_um,
            step_um=self.step_um or reach.depth_step_um(lens, nearest_um),
        )


@dataclass(frozen=True, slots=True)
class SensitivityScenes:
    """What the sensitivity of whole scenes is measured on.

    count, seed: of the scenes. gaze_step_deg, slip_step_mm: from the anchor (the
    paper's kind of step).
    pitch_um, pixels: of the sensor. window_um: of the PSFs, which are normalised to the
    light within it.
    image_tolerance: of the image, relative L2 of a texture.
    """

    count: int = 24
    seed: int = 11
    gaze_step_deg: float = 1.0
    slip_step_mm: float = field(default=0.5, metadata={"signed": True})
    pitch_um: float = 12.0
    pixels: int = 120
    window_um: float = 288.0
    image_tolerance: float = field(default=0.015, metadata={"above": 0})

    def __post_init__(self) -> None:
        check_ranges(
            self,
            count=(1, 100_000),
            pitch_um=(LEAST, LARGEST),
            pixels=(8, 4096),
            window_um=(4 * self.pitch_um, LARGEST),
        )
        if not (0 < abs(self.gaze_step_deg) <= 20 and 0 < abs(self.slip_step_mm) <= 5):
            raise ConfigError(
                f"gaze_step_deg = {self.gaze_step_deg}, slip_step_mm = {self.slip_step_mm}: need steps other than 0, "
                "up to 20 degrees and 5 mm"
            )


@dataclass(frozen=True, eq=False, slots=True)
class AxialInformation:
    """Axial information of one lens.

    information: (angles, binnings, depths) I(z) per mm², mean over sub-pixel positions.
    encircled: (angles, depths) share of the light through the lens in a circle of
    ``radius_um``, placed where it holds most.
    psf_error: relative error of the PSF engine.
    """

    information: Tensor
    encircled: Tensor
    psf_error: float


def measure_axial_information(
    lens: Lens, setting: MeasurementSettings | None = None
) -> AxialInformation:
    """Axial information I(z) of Eq. 11 of the full pillar lens, at every field angle
    and binning.

    PSFs at every depth z and z + step give the derivative by z.

    Args:
        lens: lens to measure.
        setting: depths, angles and pixels. What is left out is the default of this lens:
            to compare lenses, pass :meth:`MeasurementSettings.about` of one.
    """
    resolved = (setting or MeasurementSettings()).about(lens)
    depths_um = np.linspace(*resolved.depths_mm, resolved.count) * 1e3
    samples = round(resolved.window_um / resolved.sample_um)
    angles = tuple((math.radians(angle_deg), 0.0) for angle_deg in resolved.angles_deg)
    stacks = [
        from_lens(
            lens,
            View(tuple(z_um), angles, resolved.window_um, samples),
            tolerance=resolved.tolerance,
        )
        for z_um in (depths_um, depths_um + resolved.step_um)
    ]
    shape = len(angles), resolved.count
    near, far = (
        torch.as_tensor(stack.intensity).reshape(*shape, samples, samples)
        for stack in stacks
    )
    information = [
        axial_information(
            near,
            far,
            step_um=resolved.step_um,
            sample_um=resolved.sample_um,
            pixel_um=resolved.pixel_um * binning,
            normalisation=resolved.normalisation,
        )
        for binning in resolved.binnings
    ]
    passed = [passed_um2(lens, angle, tuple(depths_um)) for angle in angles]
    energy_um2 = torch.as_tensor(stacks[0].energy_um2).reshape(shape)
    share = energy_um2 / torch.as_tensor(np.array(passed))
    inside = most_encircled(near, resolved.sample_um, radius_um=resolved.radius_um)
    return AxialInformation(
        torch.stack(information, 1),
        inside * share.clamp(max=1.0),
        max(float(stack.error) for stack in stacks),
    )


def most_encircled(intensity: Tensor, sample_um: float, *, radius_um: float) -> Tensor:
    """(...) largest light within a circle of a radius, over all places of the circle in
    the window.

    Sums over the circle are the cyclic convolution with a disc whose rim samples count
    by their coverage. Off axis the core of a PSF is neither at the chief ray nor at the
    centroid.

    Args:
        intensity: (..., y, x) PSFs.
        sample_um: distance of the samples.
        radius_um: radius of the circle.
    """
    count = intensity.shape[-1]
    offset = (
        torch.arange(count, dtype=torch.float64) + count // 2
    ) % count - count // 2  # distance from index 0, cyclic
    disc = (
        (radius_um / sample_um + 0.5 - torch.hypot(offset[:, None], offset))
        .clamp(0, 1)
        .to(intensity)
    )
    encircled: Tensor = torch.fft.irfft2(
        torch.fft.rfft2(intensity) * torch.fft.rfft2(disc), s=(count, count)
    )
    largest: Tensor = encircled.amax((-2, -1))
    return largest


@dataclass(frozen=True, eq=False, slots=True)
class SceneEnergy:
    """Table 1 of one lens: (scenes,) squared differences of energy-matched images,
    summed over pixels.

    gaze: |I_gaze - I_anchor|². slip: |I_slip - I_anchor|².
    separability: |I_gaze - I_slip|².
    image_error: relative L2 error of the image of a texture.
    maps: (3, y, x) of the first scene: anchor, squared change with gaze, squared
    difference of gaze and slip (Fig. 5).
    above: why the image error exceeds its tolerance; empty otherwise.
    """

    gaze: Tensor
    slip: Tensor
    separability: Tensor
    image_error: float
    maps: Tensor
    above: str = ""

    @property
    def span_angle_deg(self) -> float:
        """Mean span angle of Eq. 5 between the changes with gaze and with slip."""
        along = (self.gaze + self.slip - self.separability) / (
            2 * torch.sqrt(self.gaze * self.slip).clamp_min(1e-300)
        )
        return float(torch.rad2deg(torch.arccos(along.clamp(-1, 1))).mean())


def scene_energies(
    lenses: Sequence[Lens], states: EyeStates, settings: SensitivityScenes | None = None
) -> list[SceneEnergy]:
    """Change of the images of the same scenes with gaze and with axial slip, lens by
    lens (Table 1).

    Images of all lenses are scaled to the same mean; the paper normalises the PSFs'
    sums. The steps are finite as in the paper, not infinitesimal.

    Args:
        lenses: lenses of one sensor distance.
        states: eye states of the anchor views.
        settings: of the scenes; their defaults without it.

    Raises:
        SceneError: no lens is given, or they differ in their sensor distance.
    """
    if not lenses:
        raise SceneError("no lens to evaluate; give at least one")
    settings = settings or SensitivityScenes()
    distance_um = lenses[0].reduced_um
    for number, lens in enumerate(lenses):
        if abs(lens.reduced_um / distance_um - 1) > 1e-3:
            raise SceneError(
                f"lens {number + 1} is made for a sensor at {lens.reduced_um:g} um (through films: reduced), the first "
                f"for {distance_um:g} um: their images differ in size; compare lenses of one sensor distance"
            )
    views = scene_views(states, settings, sensor_distance_um=distance_um)
    visible_um = torch.cat([f.depth_um[f.coverage > 0] for f in views])
    # at least 5 and 6 mm
    depths_um = max(float(visible_um.min()), 5e3), max(float(visible_um.max()), 6e3)
    window_samples = 2 * math.ceil(settings.window_um / (2 * settings.pitch_um)) + 1
    shape = (settings.pixels, settings.pixels)
    grid = Grid(shape, settings.pitch_um, depths_um, 0, window_samples)
    results = []
    for lens in lenses:
        optics = imager(lens, grid, tolerance=settings.image_tolerance)
        images = [optics(frames) for frames in views]
        anchor, gaze, slip = (
            image / images[0].mean((1, 2), keepdim=True) for image in images
        )
        changes = [(gaze - anchor) ** 2, (slip - anchor) ** 2, (gaze - slip) ** 2]
        of_gaze, of_slip, separability = (change.sum((1, 2)) for change in changes)
        results.append(
            SceneEnergy(
                of_gaze,
                of_slip,
                separability,
                optics.error,
                torch.stack([anchor[0], changes[0][0], changes[2][0]]),
                optics.above(settings.image_tolerance),
            )
        )
    return results


def scene_views(
    states: EyeStates, settings: SensitivityScenes, *, sensor_distance_um: float
) -> list[Frames]:
    """Rendered anchor, gaze and slip views of eye states, at the exposure of the
    anchor.

    Args:
        states: eye states of the anchor views.
        settings: steps, pitch and pixels.
        sensor_distance_um: distance from lens to sensor.
    """
    motions = (
        ("gaze_rad", 0, math.radians(settings.gaze_step_deg)),
        ("slip_um", 2, 1e3 * settings.slip_step_mm),
    )
    rig = replace(CameraRig(), sensor_distance_um=sensor_distance_um)
    camera = PinholeCamera(settings.pixels, settings.pitch_um)
    return [
        render(moved, rig=rig, camera=camera, exposed=states).frames
        for moved in moved_states(states, motions)
    ]


def lens_ratios(
    scenes: Mapping[str, SceneEnergy],
) -> dict[str, dict[str, tuple[float, float, float]]]:
    """{lens: {kind: (ratio to the first lens, low, high)}} of Table 1, with 95 %
    bootstrap intervals over the scenes.

    Args:
        scenes: scene sensitivity by name of the lens.
    """
    reference = next(iter(scenes.values()))
    return {
        name: {
            kind: bootstrap_ratio(
                *(getattr(compared, kind).numpy() for compared in (energy, reference))
            )
            for kind in KINDS
        }
        for name, energy in scenes.items()
    }


def table_values(
    axial: Mapping[str, AxialInformation],
    scenes: Mapping[str, SceneEnergy],
    setting: MeasurementSettings,
) -> dict[str, Any]:
    """Every number of the tables, ready for JSON.

    Args:
        axial: axial information by name of the lens.
        scenes: scene sensitivity by name of the lens.
        setting: how the lenses were measured.
    """
    ratios = lens_ratios(scenes)
    return {
        "depths_mm": np.linspace(*setting.depths_mm, setting.count).tolist(),
        "angles_deg": list(setting.angles_deg),
        "binnings": list(setting.binnings),
        "normalisation": setting.normalisation,
        "lenses": {
            name: {
                "information_per_mm2": measured.information.tolist(),
                "encircled_energy": measured.encircled.tolist(),
                "psf_error": measured.psf_error,
                "scene_ratios": {kind: list(v) for kind, v in ratios[name].items()},
                "span_angle_deg": scenes[name].span_angle_deg,
                "image_error": scenes[name].image_error,
            }
            for name, measured in axial.items()
        },
    }


def table_failures(
    axial: Mapping[str, AxialInformation],
    scenes: Mapping[str, SceneEnergy],
    setting: MeasurementSettings,
) -> list[str]:
    """Sentences on every PSF and image whose error exceeds its tolerance.

    Args:
        axial: axial information by name of the lens.
        scenes: scene sensitivity by name of the lens.
        setting: how the lenses were measured.
    """
    tolerance = setting.tolerance
    above = [
        f"{name}: the PSFs' error {measured.psf_error:.2g} is above axial.tolerance = {tolerance:g}"
        for name, measured in axial.items()
        if measured.psf_error > tolerance
    ]
    return above + [
        f"{name}: {measured.above}"
        for name, measured in scenes.items()
        if measured.above
    ]


def axial_table(
    axial: Mapping[str, AxialInformation],
    setting: MeasurementSettings,
    remarks: Sequence[str] = (),
) -> Table:
    """Table 3: mean I(z) at every angle, a row for each lens and binning, and the least
    encircled energy on axis and at all angles.

    Args:
        axial: axial information by name of the lens.
        setting: how the lenses were measured.
        remarks: lines of the caption, on lenses that do not focus.
    """
    low, high = setting.depths_mm
    caption = (
        f"Axial information I(z) of Eq. 11 per mm², mean over {low:g}–{high:g} mm, {setting.normalisation} "
        f"normalisation, averaged over sub-pixel positions; pixels of {setting.pixel_um:g} µm. Light: the least share "
        f"within {setting.radius_um:g} µm over the depths."
        + "".join(f"\n{line}." for line in remarks)
    )
    angles = [f"{angle:g}°" for angle in setting.angles_deg]
    head = ("lens", "binning", *angles, "light on axis", "light at all angles")
    rows: list[tuple[str, ...]] = []
    for name, measured in axial.items():
        light = (measured.encircled[0].min(), measured.encircled.min())
        shares = [f"{float(share):.2f}" for share in light]
        for k, binning in enumerate(setting.binnings):
            means = measured.information[:, k].mean(-1).tolist()
            words = [f"{mean:.3g}" for mean in means]
            rows.append((name, f"{binning} × {binning}", *words, *shares))
            name, shares = "", ["", ""]
    return Table(head, rows, caption)


def scene_table(scenes: Mapping[str, SceneEnergy]) -> Table:
    """Table 1: ratios to the first lens with 95 % intervals, span angle, image
    error.

    Args:
        scenes: scene sensitivity by name of the lens.
    """
    first = next(iter(scenes))
    caption = f"Energy-matched images of {len(scenes[first].gaze)} scenes: ratio to {first}, 95 % interval over the scenes."
    rows = []
    for name, ratios in lens_ratios(scenes).items():
        energy = scenes[name]
        intervals = ["{:.2f} [{:.2f}, {:.2f}]".format(*r) for r in ratios.values()]
        rows.append(
            (
                name,
                *intervals,
                f"{energy.span_angle_deg:.1f}°",
                f"{energy.image_error:.3f}",
            )
        )
    return Table(("lens", *KINDS, "span angle", "image error"), rows, caption)


CAPTIONS = {
    "axial": "Axial information on axis (Eq. 11) over depth for each binning, averaged over sub-pixel positions.",
    "scenes": "First scene: the sensor image, its squared change with gaze, and the squared difference between gaze "
    "and slip, on one scale for all lenses.",
}


def plot_axial_information(
    axial: Mapping[str, AxialInformation], setting: MeasurementSettings
) -> bytes:
    """PNG of I(z) over depth on axis, a panel for each binning.

    Args:
        axial: axial information by name of the lens.
        setting: how the lenses were measured.
    """
    depths = np.linspace(*setting.depths_mm, setting.count)
    count = len(setting.binnings)
    figure, panels = make_figure(1, count, size=(1.5 + 3.2 * count, 3.2), squeeze=False)
    for k, (panel, binning) in enumerate(zip(panels[0], setting.binnings, strict=True)):
        for name, info in axial.items():
            mean = float(info.information[0, k].mean())
            shown = info.information[0, k].clamp_min(max(1e-6 * mean, 1e-30)).numpy()
            panel.semilogy(depths, shown, ".-", label=f"{name}: {mean:.3g}")
        panel.set(
            title=f"{binning} × {binning} of {setting.pixel_um:g} µm",
            xlabel="source depth / mm",
        )
        panel.legend(fontsize=7, title="mean", title_fontsize=7)
    panels[0, 0].set_ylabel(f"I(z) / mm⁻² ({setting.normalisation})")
    return figure_png(figure)


def plot_scenes(energies: Mapping[str, SceneEnergy]) -> bytes:
    """PNG of the first scene through every lens: image, squared change with gaze,
    squared difference of gaze and slip.

    Args:
        energies: scene sensitivity by name of the lens.
    """
    titles = ("image", "(gaze − anchor)²", "(gaze − slip)²")
    figure, panels = make_figure(
        len(energies), 3, size=(8.4, 0.5 + 2.6 * len(energies)), squeeze=False
    )
    maps = torch.stack([energy.maps for energy in energies.values()])
    full = torch.quantile(maps.transpose(0, 1).flatten(1), 0.998, dim=1).clamp_min(
        1e-12
    )
    for row, name, pictures in zip(panels, energies, maps, strict=True):
        row[0].set_ylabel(name, fontsize=8)
        for k, panel in enumerate(row):
            colours = "magma" if k else "gray"
            panel.imshow(pictures[k].numpy(), cmap=colours, vmin=0, vmax=float(full[k]))
            panel.set(xticks=[], yticks=[])
            panel.grid(False)
    for panel, title in zip(panels[0], titles, strict=True):
        panel.set_title(title)
    return figure_png(figure)
