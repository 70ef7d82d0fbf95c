"""How objectives of the optics rank lenses, against the depth error of one small
network trained with each.

    python -m benchmarks.fisher_ranking          # docs/fisher/ranking.json and ranking.md, about two minutes

The errors come from ``benchmarks/results/codesign_study.json`` (pixels of 18 um, one
seed, 25 600 frames a lens).
"""

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import rankdata
from torch import Tensor

from benchmarks.codesign_study import CASES, SCENES, optics_of
from benchmarks.rivals import blind_texture
from benchmarks.rivals.blind_texture import Texture
from codesign.batches.flat import irradiance
from codesign.batches.scenes import TEST, EyeScenes
from codesign.evaluate.scenes import SceneObjective
from codesign.optics import stack as optics
from metalens import fisher
from metalens.design.free_form import simple_lenses as baselines
from metalens.design.free_form.search import Fisher, score
from metalens.design.profiles import Focus
from metalens.image import pupil
from metalens.image.pupil import Pupil
from metalens.image.scene import Frames
from metalens.image.sensor import Sensor, mean_electrons, variance

LENSES = (
    "hyper20",
    "hyper24",
    "hyper28",
    "hyper33",
    "hyper40",
    "hyper50",
    "helix2",
    "helix3",
)
ROOT = Path(__file__).parents[1]
STUDY = ROOT / "benchmarks" / "results" / "codesign_study.json"
DOCS = ROOT / "docs" / "fisher"
PUPIL = Pupil(nodes=160)
FOCUS = Focus(PUPIL.wavelength_um, PUPIL.sensor_distance_um, 20e3)
CASE = CASES["p18"]
SENSOR = Sensor(CASE.pitch_um, 9.0, CASE.electrons, 0.0, 2 * CASE.electrons, 5.0, 10)
DEPTHS = torch.linspace(16e3, 26e3, 11, dtype=torch.float64)
ALBEDO, STEP_UM, SAMPLE_UM = 0.3, 200.0, 0.75
CHECK = " at contrast "
# mm per mm: networks that answer less to depth than this guess, and their errors are
# one
DEAF = 0.05
CONTRASTS = (
    0.2,
    0.05,
    0.1,
    0.4,
)  # of the blind texture: the first is reported, the others check
READS = 4  # waves across the frame up to which its texture is unknown


def measures(lens: str, scenes: SceneObjective, frames: Frames) -> dict[str, float]:
    """All objectives of one lens, each so that more is better."""
    settings, _ = optics_of(lens)
    phase, focus_um = (
        baselines.baseline_phase(PUPIL, settings.zones),
        settings.focus_mm * 1e3,
    )
    found: dict[str, float] = {}
    for kind in ("l2", "sum"):
        for binning in (1, 2, 3):
            asked = Fisher(pixel_um=3.0 * binning, normalisation=kind).about(
                FOCUS, PUPIL.radius_um
            )
            made = score(phase, PUPIL, focus_um=focus_um, settings=asked)
            found[f"I(z) {kind}, {binning} x {binning}"] = float(
                made.information.mean()
            )
    found["encircled energy, least"] = float(made.encircled.min())
    found["encircled energy, mean"] = float(made.encircled.mean())
    found["Eq. 6 on scenes (minus loss)"] = float(
        scenes.judge(phase, focus_um).information
    )
    found |= blind(phase, focus_um)
    found |= scene_information(lens, frames)
    return found


def blind(phase: Tensor, focus_um: float) -> dict[str, float]:
    """Blind-texture measures at the pixels and the noise of the study, at every
    contrast.
    """
    noise = blind_texture.relative_noise(SENSOR, albedo=ALBEDO)
    view: dict[str, Any] = dict(focus_um=focus_um, sample_um=SAMPLE_UM, samples=360)
    near, here, far = (
        pupil.psf(phase, PUPIL, depths_um=DEPTHS + shift, **view)
        for shift in (-STEP_UM / 2, 0.0, STEP_UM / 2)
    )
    found = {}
    for contrast in CONTRASTS:
        texture = Texture(CASE.pitch_um, pixels=32, contrast=contrast, noise=noise)
        setting: dict[str, Any] = dict(
            step_um=STEP_UM, sample_um=SAMPLE_UM, texture=texture
        )
        known = blind_texture.blind_information(near, far, **setting)
        unknown = blind_texture.blinder_information(near, far, **setting)
        error = blind_texture.blind_error(
            here, DEPTHS, sample_um=SAMPLE_UM, texture=texture
        )
        end = "" if contrast == CONTRASTS[0] else f"{CHECK}{contrast}"
        found["blind texture J(z)" + end] = float(known.mean())
        found["blind texture J(z), contrast and fall unknown" + end] = float(
            unknown.mean()
        )
        found["blind texture, confusion of depths (minus mm)" + end] = -float(
            error.mean()
        )
    return found


def scene_information(lens: str, frames: Frames) -> dict[str, float]:
    """Noise-weighted information on depth of whole frames, with and without nuisances,
    mean over the frames.
    """
    plain, known = frame_information(lens, frames)
    return {
        "scene Fisher information of depth alone": float(np.mean(plain)),
        "scene Fisher information, brightness, size, place, texture unknown": float(
            np.mean(known)
        ),
    }


def frame_information(
    lens: str, frames: Frames, *, made: optics.Stack | None = None
) -> tuple[list[float], list[float]]:
    """Information on depth of every frame, alone and with the nuisances unknown, per
    mm²; ``made``: other PSFs.

    Depth moves the blur alone (the scale ambiguity: the pinhole image stays).
    Nuisances: brightness, size, two
    shifts, and the texture: the radiance times every wave of up to ``READS`` periods
    across the frame.
    """
    settings = replace(optics_of(lens)[0], depth_count=48)
    made = optics.stack(settings, torch.zeros(0)) if made is None else made
    size = frames.radiance.shape[-1]
    ready = optics.prepared(settings, made, size, margin=SCENES.margin)

    def electrons(light: Frames) -> Tensor:
        image = irradiance(light, ready, margin=SCENES.margin)
        return mean_electrons(image, settings.sample_um, sensor=SENSOR).double()

    plain, known = [], []
    waves = _waves(size)
    for n in range(len(frames.radiance)):
        one = Frames(*(getattr(frames, name)[n : n + 1] for name in Frames.__slots__))
        low, here, high = (
            electrons(replace(one, depth_um=one.depth_um + s))
            for s in (-STEP_UM, 0.0, STEP_UM)
        )
        rest = (a.expand(len(waves), -1, -1, -1) for a in (one.coverage, one.depth_um))
        many = Frames(one.radiance * waves[:, None], *rest)
        down, across = torch.gradient(here[0])
        axis = torch.arange(len(down), dtype=torch.float64) - (len(down) - 1) / 2
        grown = axis[:, None] * down + axis * across
        slope = (high - low) / (2 * STEP_UM * 1e-3)
        jacobians = torch.cat(
            [slope, here, torch.stack([grown, down, across]), electrons(many)]
        )
        matrix = fisher.information(jacobians, variance(here[0], sensor=SENSOR))
        plain.append(float(matrix[0, 0]))
        known.append(float(fisher.without_nuisance(matrix, 1)))
    return plain, known


def _waves(size: int) -> Tensor:
    """(waves, y, x) cosines and sines of up to READS periods across the frame."""
    turn = 2 * torch.pi * torch.arange(size, dtype=torch.float32) / size
    half = [
        (v, u) for v in range(READS + 1) for u in range(-READS, READS + 1) if v or u > 0
    ]
    angle = torch.stack(
        [v * turn[:, None] + u * turn for v, u in half if v**2 + u**2 <= READS**2]
    )
    return torch.cat([torch.cos(angle), torch.sin(angle)])


def spearman(values: list[float], errors: list[float]) -> tuple[float, float]:
    """Rank correlation of a measure with minus the error (1: ranks lenses as the task),
    and its exact two-sided p.
    """
    a, b = (rankdata(v) - (len(v) + 1) / 2 for v in (values, [-e for e in errors]))
    size = float(np.sqrt((a @ a) * (b @ b)))
    if size == 0:
        return 0.0, 1.0
    orders = np.array(list(itertools.permutations(range(len(a)))))
    every = b[orders] @ a / size
    own = float(a @ b / size)
    return own, float((np.abs(every) >= abs(own) - 1e-12).mean())


def ranked(found: dict[str, dict[str, float]], study: dict[str, Any]) -> dict[str, Any]:
    """Correlations of every measure: with all errors, and with those of deaf networks
    tied.
    """
    names = list(found)
    errors = [study[n]["axial_by_seed_mm"][0] for n in names]
    deaf = [abs(study[n]["response_mm_per_mm"]) < DEAF for n in names]
    chance = float(
        np.mean([e for e, d in zip(errors, deaf, strict=True) if d] or [0.0])
    )
    tied = [chance if d else e for e, d in zip(errors, deaf, strict=True)]
    out = {}
    for measure in found[names[0]]:
        values = [found[n][measure] for n in names]
        (rho, p), (rho_tied, p_tied) = spearman(values, errors), spearman(values, tied)
        out[measure] = {
            "rho": rho,
            "p": p,
            "rho_tied": rho_tied,
            "p_tied": p_tied,
            "best": names[int(np.argmax(values))],
        }
    return {
        "what": "Spearman rank correlation of each measure with minus the axial error, exact two-sided p; tied: lenses "
        "whose network does not answer to depth share one error",
        "axial_error_mm": dict(zip(names, errors, strict=True)),
        "deaf": [n for n, d in zip(names, deaf, strict=True) if d],
        "measures": found,
        "correlation": out,
    }


def table(values: dict[str, Any]) -> str:
    """Markdown of the ranking."""
    errors, every = values["axial_error_mm"], values["correlation"]
    order = sorted(
        (i for i in every.items() if CHECK not in i[0]),
        key=lambda item: -item[1]["rho"],
    )
    best = min(errors, key=errors.get)
    lines = [
        *_head(values),
        f"| objective (more is better) | all errors | guesses tied | best lens (task: {best}) |",
    ]
    lines.append("|---|---|---|---|")
    for name, c in order:
        both = (
            f"{c['rho']:+.2f} ({c['p']:.3f}) | {c['rho_tied']:+.2f} ({c['p_tied']:.3f})"
        )
        lines.append(f"| {name} | {both} | {c['best']} |")
    lines += [
        "",
        f"Blind texture of contrast {CONTRASTS[0]}; at the other contrasts that were tried, all errors:",
        "",
    ]
    for name in (n for n, _ in order if n + CHECK + str(CONTRASTS[1]) in every):
        tried = ", ".join(
            f"{every[f'{name}{CHECK}{c}']['rho']:+.2f} at {c}" for c in CONTRASTS[1:]
        )
        lines.append(f"- {name}: {tried}")
    lines += [
        "",
        f"Caveat: {len(errors)} lenses, most of one family, one seed each. A correlation below about 0.74 cannot be "
        f"told from none at 5 %; over the {len(order)} objectives of this table a single p should be below "
        f"{0.05 / len(order):.4f} to count at 5 % in all.",
        "",
    ]
    return "\n".join(lines)


def _head(values: dict[str, Any]) -> list[str]:
    errors = sorted(values["axial_error_mm"].items(), key=lambda item: item[1])
    return [
        "# Which objective ranks lenses as the task does",
        "",
        f"Written by `python -m benchmarks.fisher_ranking`. Axial error of one small network trained with each of "
        f"{len(errors)} lenses (pixels of 18 um, seed 0, 25 600 frames, scale ambiguity):",
        "",
        "| lens | axial error / mm |",
        "|---|---|",
        *(
            f"| {n} | {e:.2f}{' (guesses)' if n in values['deaf'] else ''} |"
            for n, e in errors
        ),
        "",
        "Spearman rank correlation with minus that error (1 ranks as the task does, -1 backwards), exact p over all "
        "orders in brackets. In the second column the lenses whose network does not answer to depth at all (less than "
        f"{DEAF} mm per mm) share one error, as their order is noise.",
        "",
    ]


def main() -> None:
    """Measure all lenses, write JSON and table."""
    torch.set_num_threads(1)
    study = {line["lens"]: line for line in json.loads(STUDY.read_text())["p18"]}
    scenes = SceneObjective(
        PUPIL, Fisher(scenes=4, objective="scenes").about(FOCUS, PUPIL.radius_um)
    )
    frames = EyeScenes(SCENES, 9.0, 2000.0, 0, TEST).rendered(0, 4).frames
    found = {}
    for name in (n for n in LENSES if n in study):
        found[name] = measures(name, scenes, frames)
        print(name, {k: round(v, 4) for k, v in found[name].items()}, flush=True)
    values = ranked(found, study)
    DOCS.mkdir(parents=True, exist_ok=True)
    (DOCS / "ranking.json").write_text(json.dumps(values, indent=1) + "\n")
    (DOCS / "ranking.md").write_text(table(values))


if __name__ == "__main__":
    main()
