"""Lenses compared as the paper compares them: axial information on and off axis (Table 3, Fig. 7), and the sensitivity
of whole scenes to gaze and slip (Table 1, Fig. 5), with confidence intervals over scenes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from codesign.dataset import triplets
from codesign.eye import Rig, States
from codesign.renderer import Camera, Rendered
from metalens import scene
from metalens.errors import SceneError
from metalens.fisher import Normalisation, axial_information, encircled_energy
from metalens.lens import Lens
from metalens.psf import View, from_lens
from metalens.sensor import integrate

Tensor = torch.Tensor
STEP_UM = 200.0  # of the difference in Eq. 11


@dataclass(frozen=True, slots=True)
class Setting:
    """How lenses are measured.

    depths_mm, count: of I(z). angles_deg: field angles. pixel_um, binnings: pixels. normalisation: of Eq. 11.
    window_um, sample_um: of the PSFs; light outside the window counts as lost. tolerance: of the PSF engine.
    """

    depths_mm: tuple[float, float] = (16.0, 26.0)
    count: int = 11
    angles_deg: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    pixel_um: float = 3.0
    binnings: tuple[int, ...] = (1, 2, 3)
    normalisation: Normalisation = "l2"
    window_um: float = 192.0
    sample_um: float = 0.75
    radius_um: float = 18.0
    tolerance: float = 1e-3


@dataclass(frozen=True, eq=False, slots=True)
class Axial:
    """Honest axial information of one lens.

    information: (angles, binnings, depths) per mm², over sub-pixel positions. encircled: (angles, depths) share of the
    light through the lens that falls within the radius of the PSF's centroid. psf_error: estimate of the engine.
    """

    information: Tensor
    encircled: Tensor
    psf_error: float


def axial(lens: Lens, setting: Setting | None = None) -> Axial:
    """I(z) of Eq. 11 of the full pillar lens, at every angle and binning, through the PSF engine."""
    s = setting or Setting()
    depths = np.linspace(1e3 * s.depths_mm[0], 1e3 * s.depths_mm[1], s.count)
    both = np.sort(np.concatenate([depths, depths + STEP_UM]))
    samples = round(s.window_um / s.sample_um)
    angles = tuple((math.radians(a), 0.0) for a in s.angles_deg)
    stack = from_lens(lens, View(tuple(both), angles, s.window_um, samples), tolerance=s.tolerance)
    where = [int(np.argmin(np.abs(both - d))) for d in (*depths, *(depths + STEP_UM))]
    intensity = torch.as_tensor(stack.intensity)[..., where, :, :].reshape(len(angles), 2, s.count, samples, samples)
    values = []
    for b in s.binnings:
        values.append(
            axial_information(
                intensity[:, 0],
                intensity[:, 1],
                step_um=STEP_UM,
                sample_um=s.sample_um,
                pixel_um=s.pixel_um * b,
                normalisation=s.normalisation,
            )
        )
    light = torch.as_tensor(stack.energy_um2)[..., where[: s.count]].reshape(len(angles), s.count)
    passed = float((lens.transmission() ** 2).sum()) * lens.diameters.pitch_um**2
    share = light / passed / torch.cos(torch.tensor([a for a, _ in angles]))[:, None]
    inside = encircled_energy(_centred(intensity[:, 0]), s.sample_um, radius_um=s.radius_um)
    return Axial(torch.stack(values, 1), inside * share.clamp(max=1.0), float(stack.error))


def _centred(intensity: Tensor) -> Tensor:
    """PSFs moved by whole samples so that their centroid is in the middle of the window."""
    n = intensity.shape[-1]
    grid = torch.arange(n, dtype=intensity.dtype) - (n - 1) / 2
    y = (intensity.sum(-1) * grid).sum(-1).round().long()
    x = (intensity.sum(-2) * grid).sum(-1).round().long()
    flat = intensity.reshape(-1, n, n)
    moved = [torch.roll(p, (-int(a), -int(b)), (0, 1)) for p, a, b in zip(flat, y.flatten(), x.flatten(), strict=True)]
    return torch.stack(moved).reshape(intensity.shape)


@dataclass(frozen=True, eq=False, slots=True)
class SceneEnergy:
    """Table 1 of one lens: (scenes,) squared differences of energy-matched images, summed over pixels.

    gaze: |I_gaze - I_anchor|². slip: |I_slip - I_anchor|². separability: |I_gaze - I_slip|².
    """

    gaze: Tensor
    slip: Tensor
    separability: Tensor


def scene_energies(
    lenses: Sequence[Lens],
    states: States,
    *,
    gaze_step_rad: float = math.radians(1.0),
    slip_step_um: float = 500.0,
    pitch_um: float = 6.0,
    pixels: int = 256,
    window_um: float = 192.0,
) -> list[SceneEnergy]:
    """Table 1: how much the images of the same scenes change with gaze and with axial slip.

    Images of all lenses are scaled to the same mean (the paper normalises the PSFs' sums). The steps are the paper's
    kind of perturbation, not infinitesimal ones.

    Raises:
        SceneError: no lens is given.
    """
    if not lenses:
        raise SceneError("no lens to evaluate; give at least one")
    rig = Rig()
    camera = Camera(pixels, pitch_um)
    views = triplets(states, gaze_step_rad=gaze_step_rad, slip_step_um=slip_step_um, rig=rig, camera=camera)
    out = []
    for lens in lenses:
        basis = lens_basis(lens, (views.anchor, views.gaze, views.slip), pitch_um=pitch_um, window_um=window_um)
        optics = scene.imager(basis, (pixels, pixels))
        images = [scene.image(v.frames, optics) for v in (views.anchor, views.gaze, views.slip)]
        anchor, gaze, slip = (i / images[0].mean((1, 2), keepdim=True) for i in images)
        sums = [((a - b) ** 2).sum((1, 2)) for a, b in ((gaze, anchor), (slip, anchor), (gaze, slip))]
        out.append(SceneEnergy(*sums))
    return out


def lens_basis(
    lens: Lens, views: Sequence[Rendered], *, pitch_um: float, window_um: float = 192.0, tolerance: float = 1e-3
) -> scene.PsfBasis:
    """PSFs of a lens on the pixel grid, at the depths that these frames hold, as a few kernels."""
    seen = torch.cat([v.frames.depth_um[v.frames.coverage > 0] for v in views])
    low, high = max(float(seen.min()), 5e3), max(float(seen.max()), 6e3)
    count = max(2, math.ceil((1 / low - 1 / high) / (500.0 / 21e3**2)) + 1)  # 0.5 mm at the pupil, more beyond
    depths = 1 / torch.linspace(1 / high, 1 / low, count, dtype=torch.float64).flip(0)
    fine, window = max(1, math.ceil(pitch_um / 0.85)), 2 * math.ceil(window_um / (2 * pitch_um))
    view = View(tuple(depths.tolist()), ((0.0, 0.0),), window * pitch_um, window * fine)
    stack = torch.as_tensor(from_lens(lens, view, tolerance=1e-3).intensity).reshape(count, window * fine, -1)
    pixels = integrate(stack, pitch_um / fine, pitch_um=pitch_um, shape=(window + 1, window + 1))  # odd: centred
    return scene.basis(pixels / pixels.sum((1, 2), keepdim=True), depths, tolerance=tolerance)


def ratio(values: Tensor, reference: Tensor, *, draws: int = 2000, seed: int = 0) -> tuple[float, float, float]:
    """Ratio of means over scenes and its 95 % interval, by a paired bootstrap over the scenes."""
    rng = np.random.default_rng(seed)
    a, b = values.double().numpy(), reference.double().numpy()
    rows = rng.integers(0, len(a), (draws, len(a)))
    low, high = np.quantile(a[rows].mean(1) / b[rows].mean(1), [0.025, 0.975])
    return float(a.mean() / b.mean()), float(low), float(high)


def tables(names: Sequence[str], lenses: Sequence[Lens], states: States, *, setting: Setting | None = None) -> str:
    """Tables 1 and 3 of the paper for these lenses, as text; ratios are against the first lens."""
    s = setting or Setting()
    lines = [f"Axial information I(z), {s.normalisation} normalisation, mean over {s.depths_mm} mm, per mm²"]
    lines.append(f"{'lens':<20}" + "".join(f"{a:>9g}deg" for a in s.angles_deg) + "   binning   least encircled energy")
    for name, lens in zip(names, lenses, strict=True):
        found = axial(lens, s)
        for k, b in enumerate(s.binnings):
            row = "".join(f"{float(v):12.3f}" for v in found.information[:, k].mean(-1))
            lines.append(f"{name if k == 0 else '':<20}{row}   {b} x {b}     {float(found.encircled[0].min()):.2f}")
    energies = scene_energies(lenses, states)
    lines += ["", f"Scenes: ratio to {names[0]}, 95 % interval over {len(states)} scenes"]
    for name, e in zip(names, energies, strict=True):
        parts = []
        for kind in ("gaze", "slip", "separability"):
            value, low, high = ratio(getattr(e, kind), getattr(energies[0], kind))
            parts.append(f"{kind} {value:.2f} [{low:.2f}, {high:.2f}]")
        lines.append(f"{name:<20}" + "   ".join(parts))
    return "\n".join(lines)
