"""Tables 1 and 3 of the paper for any lenses, as tables and as numbers, with intervals
over scenes.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from codesign.adapt import bootstrap_ratio
from codesign.evaluate.optics import AxialInformation, ResolvedSettings, SceneEnergy
from metalens.core.report import Table

KINDS = ("gaze", "slip", "separability")
PAPER_SCENES = {
    "gaze": 1.85,
    "slip": 1.60,
    "separability": 1.57,
}  # proposed lens against hyperbolic, Table 1
PAPER_ANGLES = (5.0, 10.0, 15.0, 20.0)
PAPER_AXIAL = {  # Table 3, averaged over 16-26 mm
    "hyperbolic": (0.24, 0.24, 0.31, 0.33),
    "double helix": (0.31, 0.31, 0.33, 0.30),
    "proposed": (1.12, 1.25, 0.92, 0.81),
}


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
            "light_in_window": energy.light,
            "image_error": None
            if math.isnan(energy.image_error)
            else energy.image_error,
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
    """Table 3 (with the field's centre, binnings and encircled energy) and Table 1, the
    paper's numbers below each;
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
            told = [f"{float(v):.3g}" for v in found.information[:, k].mean(-1)]
            least = (
                [
                    f"{float(found.encircled[0].min()):.2f}",
                    f"{float(found.encircled.min()):.2f}",
                ]
                if k == 0
                else []
            )
            rows.append(
                (name if k == 0 else "", f"{b} × {b}", *told, *(least or ["", ""]))
            )
    for name, numbers in PAPER_AXIAL.items():
        known = dict(zip(PAPER_ANGLES, numbers, strict=True))
        told = [f"{known[a]:.2f}" if a in known else "–" for a in setting.angles_deg]
        rows.append((f"paper: {name}", "", *told, "", ""))
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
        rows.append(
            (
                name,
                *parts,
                f"{angle:.1f}°",
                f"{one.light:.2f}",
                f"{one.image_error:.3f}",
            )
        )
    rows.append(
        (
            "paper: proposed",
            *(f"{PAPER_SCENES[kind]:.2f}" for kind in KINDS),
            "–",
            "–",
            "–",
        )
    )
    return Table(
        ("lens", *KINDS, "span angle", "light in window", "image error"), rows, caption
    )
