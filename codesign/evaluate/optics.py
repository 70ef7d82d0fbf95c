"""Lenses compared as the paper compares them: axial information on and off axis (Table
3, Fig. 7), and the sensitivity
of whole scenes to gaze and slip (Table 1, Fig. 5), with confidence intervals over
scenes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.eye import (
    CameraRig,
    EyeStates,
    PinholeCamera,
    RenderedFrames,
    moved_states,
    render,
)
from codesign.train import bootstrap_ratio
from metalens.core.errors import ConfigError, SceneError
from metalens.core.report import Table
from metalens.image import Grid, Imager, Normalisation, axial_information, imager
from metalens.lens import Lens, reach
from metalens.psf import View, from_lens, passed_um2

WINDOW = 56.4  # width of the PSFs, in wavelength / NA
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
    radius_um: of the encircled energy; left out, 5.3 wavelength / NA. tolerance: of the
    PSF engine.
    """

    depths_mm: tuple[float, float] | None = None
    count: int = 11
    angles_deg: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    pixel_um: float | None = None
    binnings: tuple[int, ...] = (1, 2, 3)
    normalisation: Normalisation = "l2"
    window_um: float | None = None
    sample_um: float | None = None
    radius_um: float | None = None
    tolerance: float = field(default=1e-3, metadata={"above": 0})

    def __post_init__(self) -> None:
        low, high = self.depths_mm or (1.0, 1.0)
        if not (
            0 < low <= high
            and self.count >= 1
            and self.angles_deg
            and self.binnings
            and min(self.binnings) >= 1
        ):
            raise ConfigError(
                f"depths_mm = {self.depths_mm}, count = {self.count}, angles_deg = {self.angles_deg}, binnings = "
                f"{self.binnings}: need 0 < nearest <= farthest, and at least one depth, angle and binning"
            )
        sample = 1e-6 if self.sample_um is None else self.sample_um
        wide = self.window_um is None or self.window_um >= 4 * sample
        lengths = [
            1.0 if length is None else length
            for length in (self.pixel_um, self.radius_um)
        ]
        if not (wide and sample > 0 and min(lengths) > 0):
            raise ConfigError(
                f"window_um = {self.window_um}, sample_um = {self.sample_um}, pixel_um = {self.pixel_um}, radius_um = "
                f"{self.radius_um}: need lengths above 0, and a window of four samples or more"
            )

    def about(self, lens: Lens) -> "ResolvedSettings":
        """These with what was left to the lens."""
        near, far = (
            (1e3 * z for z in self.depths_mm)
            if self.depths_mm
            else reach.depth_range_um(lens)
        )
        pixel = self.pixel_um or reach.pixel_um(lens)
        sample = self.sample_um or reach.sample_um(lens, pixel * min(self.binnings))
        window = self.window_um or reach.window_um(lens, (near, far), airy=WINDOW)
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        own |= {
            "pixel_um": pixel,
            "depths_mm": (near * 1e-3, far * 1e-3),
            "radius_um": self.radius_um or reach.disc_um(lens),
        }
        own |= {
            "sample_um": sample,
            "window_um": max(4, round(window / sample)) * sample,
        }
        return ResolvedSettings(**own, step_um=reach.depth_step_um(lens, near))


@dataclass(frozen=True, slots=True)
class ResolvedSettings(MeasurementSettings):
    """A :class:`MeasurementSettings` with nothing left to the lens. step_um: of the
    difference in
    Eq. 11.
    """

    depths_mm: tuple[float, float] = field(kw_only=True)
    pixel_um: float = field(kw_only=True)
    window_um: float = field(kw_only=True)
    sample_um: float = field(kw_only=True)
    radius_um: float = field(kw_only=True)
    step_um: float = field(kw_only=True)


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
        if not 1 <= self.count <= 100_000:
            raise ConfigError(f"count = {self.count} scenes: need 1 to 100000")
        if not (0 < abs(self.gaze_step_deg) <= 20 and 0 < abs(self.slip_step_mm) <= 5):
            raise ConfigError(
                f"gaze_step_deg = {self.gaze_step_deg}, slip_step_mm = {self.slip_step_mm}: need steps other than 0, "
                "up to 20 degrees and 5 mm"
            )
        if not (self.window_um >= 4 * self.pitch_um > 0 and 8 <= self.pixels <= 4096):
            raise ConfigError(
                f"window_um = {self.window_um}, pitch_um = {self.pitch_um}, pixels = {self.pixels}: need a pitch above "
                "0, a window of four pixels or more, and 8 to 4096 pixels"
            )


@dataclass(frozen=True, eq=False, slots=True)
class AxialInformation:
    """Honest axial information of one lens.

    information: (angles, binnings, depths) per mm², over sub-pixel positions.
    encircled: (angles, depths) share of the
    light through the lens that a circle of the radius holds, placed where it holds
    most. psf_error: of the engine.
    slices: (depths, x) the light on axis summed over y, on samples: what a line across
    the PSF's image shows.
    """

    information: Tensor
    encircled: Tensor
    psf_error: float
    slices: Tensor


def measure_axial_information(
    lens: Lens, setting: MeasurementSettings | None = None
) -> AxialInformation:
    """I(z) of Eq. 11 of the full pillar lens, at every angle and binning, through the
    PSF engine.

    What the setting leaves out is that of this lens: to compare lenses, take
    :meth:`Setting.about` of one.
    """
    s = (
        setting
        if isinstance(setting, ResolvedSettings)
        else (setting or MeasurementSettings()).about(lens)
    )
    depths = np.linspace(1e3 * s.depths_mm[0], 1e3 * s.depths_mm[1], s.count)
    both = np.sort(np.concatenate([depths, depths + s.step_um]))
    samples = round(s.window_um / s.sample_um)
    angles = tuple((math.radians(a), 0.0) for a in s.angles_deg)
    stack = from_lens(
        lens, View(tuple(both), angles, s.window_um, samples), tolerance=s.tolerance
    )
    where = [int(np.argmin(np.abs(both - d))) for d in (*depths, *(depths + s.step_um))]
    intensity = torch.as_tensor(stack.intensity)[..., where, :, :].reshape(
        len(angles), 2, s.count, samples, samples
    )
    values = []
    for b in s.binnings:
        values.append(
            axial_information(
                intensity[:, 0],
                intensity[:, 1],
                step_um=s.step_um,
                sample_um=s.sample_um,
                pixel_um=s.pixel_um * b,
                normalisation=s.normalisation,
            )
        )
    light = torch.as_tensor(stack.energy_um2)[..., where[: s.count]].reshape(
        len(angles), s.count
    )
    share = light / torch.as_tensor(
        np.array([passed_um2(lens, angle, tuple(depths)) for angle in angles])
    )
    inside = most_encircled(intensity[:, 0], s.sample_um, radius_um=s.radius_um)
    slices = intensity[0, 0].sum(1)
    return AxialInformation(
        torch.stack(values, 1),
        inside * share.clamp(max=1.0),
        float(stack.error),
        slices,
    )


def most_encircled(intensity: Tensor, sample_um: float, *, radius_um: float) -> Tensor:
    """Largest share of the light (..., y, x) that a circle of this radius holds,
    wherever in the window it lies.

    Off axis the core of a PSF is neither at the chief ray nor at the centroid, which
    haze pulls away.

    Args:
        intensity: (..., y, x) PSFs. sample_um: distance of the samples.
        radius_um: of the circle.
    """
    n = intensity.shape[-1]
    grid = (
        torch.arange(n, dtype=torch.float64) + n // 2
    ) % n - n // 2  # 0 first, as the transform counts
    inside = (
        (radius_um / sample_um + 0.5 - torch.hypot(grid[:, None], grid))
        .clamp(0, 1)
        .to(intensity)
    )
    summed: Tensor = torch.fft.irfft2(
        torch.fft.rfft2(intensity) * torch.fft.rfft2(inside), s=(n, n)
    )
    most: Tensor = summed.amax((-2, -1))
    return most


@dataclass(frozen=True, eq=False, slots=True)
class SceneEnergy:
    """Table 1 of one lens: (scenes,) squared differences of energy-matched images,
    summed over pixels.

    gaze: |I_gaze - I_anchor|². slip: |I_slip - I_anchor|². separability: |I_gaze - I_slip|².
    image_error: of the images, relative L2 of a texture.
    maps: (3, y, x) of the first scene: anchor, squared change with gaze, squared
    difference of gaze and slip (Fig. 5).
    above: why the error of the true image is above what it aims at; empty where it is
    not.
    """

    gaze: Tensor
    slip: Tensor
    separability: Tensor
    image_error: float
    maps: Tensor
    above: str = ""

    @property
    def angle_rad(self) -> Tensor:
        """(scenes,) span angle of Eq. 5 between the changes with gaze and with slip."""
        along = (self.gaze + self.slip - self.separability) / (
            2 * torch.sqrt(self.gaze * self.slip).clamp_min(1e-300)
        )
        return torch.arccos(along.clamp(-1, 1))


def scene_energies(
    lenses: Sequence[Lens], states: EyeStates, settings: SensitivityScenes | None = None
) -> list[SceneEnergy]:
    """Table 1: how much the images of the same scenes change with gaze and with axial
    slip.

    Images of all lenses are scaled to the same mean (the paper normalises the PSFs'
    sums). The steps are the paper's
    kind of perturbation, not infinitesimal ones.

    Args:
        states: subjects with gaze and slippage.
        settings: of the scenes; their defaults without it.

    Raises:
        SceneError: no lens is given, or they differ in their sensor distance.
    """
    if not lenses:
        raise SceneError("no lens to evaluate; give at least one")
    settings = settings or SensitivityScenes()
    distance = lenses[0].reduced_um
    for number, lens in enumerate(lenses):
        if abs(lens.reduced_um / distance - 1) > 1e-3:
            raise SceneError(
                f"lens {number + 1} is made for a sensor at {lens.reduced_um:g} um (through films: reduced), the first "
                f"for {distance:g} um: their images differ in size; compare lenses of one sensor distance"
            )
    views = scene_views(states, settings, sensor_distance_um=distance)
    window = 2 * math.ceil(settings.window_um / (2 * settings.pitch_um)) + 1
    grid = Grid((settings.pixels,) * 2, settings.pitch_um, depths_of(views), 0, window)
    out = []
    for lens in lenses:
        whole = imager(lens, grid, tolerance=settings.image_tolerance)
        found = energies_of(whole, views)
        out.append(replace(found, above=whole.above(settings.image_tolerance)))
    return out


def depths_of(views: Sequence[RenderedFrames]) -> tuple[float, float]:
    """Depth of the nearest and the farthest visible surface, um.

    Args:
        views: rendered views of the scenes.
    """
    seen = torch.cat([v.frames.depth_um[v.frames.coverage > 0] for v in views])
    return max(float(seen.min()), 5e3), max(float(seen.max()), 6e3)


def scene_views(
    states: EyeStates,
    settings: SensitivityScenes,
    *,
    sensor_distance_um: float = 2000.0,
) -> list[RenderedFrames]:
    """Anchor, gaze and slip views of the states, at one exposure.

    Args:
        settings: of the scenes. sensor_distance_um: lens to sensor.
    """
    motions = (
        ("gaze_rad", 0, math.radians(settings.gaze_step_deg)),
        ("slip_um", 2, 1e3 * settings.slip_step_mm),
    )
    rig = replace(CameraRig(), sensor_distance_um=sensor_distance_um)
    camera = PinholeCamera(settings.pixels, settings.pitch_um)
    return [
        render(one, rig=rig, camera=camera, exposed=states)
        for one in moved_states(states, motions)
    ]


def energies_of(optics: Imager, views: Sequence[RenderedFrames]) -> SceneEnergy:
    """Table 1 of any PSFs, see :func:`scene_energies`.

    Args:
        optics: what forms the images. views: anchor, gaze and slip views.
    """
    images = [optics(view.frames) for view in views]
    anchor, gaze, slip = (i / images[0].mean((1, 2), keepdim=True) for i in images)
    maps = [(a - b) ** 2 for a, b in ((gaze, anchor), (slip, anchor), (gaze, slip))]
    sums = [m.sum((1, 2)) for m in maps]
    return SceneEnergy(
        sums[0],
        sums[1],
        sums[2],
        optics.error,
        torch.stack([anchor[0], maps[0][0], maps[2][0]]),
    )


def lens_ratios(
    scenes: Mapping[str, SceneEnergy],
) -> dict[str, dict[str, tuple[float, float, float]]]:
    """{lens: {kind: (ratio to the first lens, low, high)}} of Table 1.

    Args:
        scenes: scene sensitivity by name of the lens.
    """
    first = next(iter(scenes.values()))
    return {
        name: {
            kind: bootstrap_ratio(*(getattr(e, kind).numpy() for e in (energy, first)))
            for kind in KINDS
        }
        for name, energy in scenes.items()
    }


def table_values(
    axial: Mapping[str, AxialInformation],
    scenes: Mapping[str, SceneEnergy],
    setting: ResolvedSettings,
) -> dict[str, Any]:
    """Every number of the tables, ready for JSON.

    Args:
        axial: axial information by name of the lens.
        scenes: scene sensitivity by name of the lens.
        setting: how the lenses were measured.
    """
    out: dict[str, Any] = {
        "depths_mm": np.linspace(*setting.depths_mm, setting.count).tolist(),
        "angles_deg": list(setting.angles_deg),
        "binnings": list(setting.binnings),
        "normalisation": setting.normalisation,
        "lenses": {},
    }
    compared = lens_ratios(scenes)
    for name, found in axial.items():
        energy = scenes[name]
        out["lenses"][name] = {
            "information_per_mm2": found.information.tolist(),
            "encircled_energy": found.encircled.tolist(),
            "psf_error": found.psf_error,
            "scene_ratios": {
                kind: list(interval) for kind, interval in compared[name].items()
            },
            "span_angle_deg": float(torch.rad2deg(energy.angle_rad).mean()),
            "image_error": energy.image_error,
        }
    return out


def table_failures(
    axial: Mapping[str, AxialInformation],
    scenes: Mapping[str, SceneEnergy],
    setting: ResolvedSettings,
) -> list[str]:
    """What of the numbers misses its tolerance, in words.

    Args:
        axial: axial information by name of the lens.
        scenes: scene sensitivity by name of the lens.
        setting: how the lenses were measured.
    """
    asked = setting.tolerance
    above = [
        f"{name}: the PSFs' error {one.psf_error:.2g} is above axial.tolerance = {asked:g}"
        for name, one in axial.items()
        if one.psf_error > asked
    ]
    return above + [f"{name}: {one.above}" for name, one in scenes.items() if one.above]


def format_tables(
    axial: Mapping[str, AxialInformation],
    scenes: Mapping[str, SceneEnergy],
    setting: ResolvedSettings,
    *,
    spread: Sequence[str] = (),
) -> list[Table]:
    """Table 3 (with the field's centre, binnings and encircled energy) and Table 1;
    spread: what is said of lenses that do not focus, a line each.

    Args:
        axial: axial information by name of the lens.
        scenes: scene sensitivity by name of the lens.
        setting: how the lenses were measured.
    """
    return [_axial(axial, setting, spread), _scenes(scenes)]


def _axial(
    axial: Mapping[str, AxialInformation],
    setting: ResolvedSettings,
    spread: Sequence[str],
) -> Table:
    low, high = setting.depths_mm
    caption = (
        f"Axial information I(z) of Eq. 11 per mm², mean over {low:g}–{high:g} mm, {setting.normalisation} "
        f"normalisation, averaged over sub-pixel positions; pixels of {setting.pixel_um:g} µm. Light: the least share "
        f"within {setting.radius_um:g} µm over the depths."
        + "".join(f"\n{line}." for line in spread)
    )
    head = (
        "lens",
        "binning",
        *(f"{angle:g}°" for angle in setting.angles_deg),
        "light on axis",
        "light at all angles",
    )
    rows: list[tuple[str, ...]] = []
    for name, found in axial.items():
        for k, b in enumerate(setting.binnings):
            means = [f"{float(v):.3g}" for v in found.information[:, k].mean(-1)]
            least = (
                [
                    f"{float(found.encircled[0].min()):.2f}",
                    f"{float(found.encircled.min()):.2f}",
                ]
                if k == 0
                else []
            )
            rows.append(
                (name if k == 0 else "", f"{b} × {b}", *means, *(least or ["", ""]))
            )
    return Table(head, rows, caption)


def _scenes(scenes: Mapping[str, SceneEnergy]) -> Table:
    first = next(iter(scenes))
    caption = f"Energy-matched images of {len(scenes[first].gaze)} scenes: ratio to {first}, 95 % interval over the scenes."
    rows: list[tuple[str, ...]] = []
    for name, found in lens_ratios(scenes).items():
        one = scenes[name]
        parts = [
            f"{value:.2f} [{low:.2f}, {high:.2f}]"
            for value, low, high in found.values()
        ]
        angle = float(torch.rad2deg(one.angle_rad).mean())
        rows.append((name, *parts, f"{angle:.1f}°", f"{one.image_error:.3f}"))
    return Table(("lens", *KINDS, "span angle", "image error"), rows, caption)
