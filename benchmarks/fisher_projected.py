"""Information on slip of whole scenes, noise-weighted and with nuisances projected out,
against the hyperbolic lens.

    python -m benchmarks.fisher_projected [FOLDER]    # docs/fisher/projected.json, about two minutes

The frames, pixels and noise of ``benchmarks.fisher_ranking``: the image without blur
stays (the scale ambiguity), and
brightness, size, place and texture of the frame are unknown. FOLDER holds designs of
``benchmarks.fisher_frontier``;
by default those of docs/fisher/designs.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.codesign_study import SCENES, optics_of
from benchmarks.fisher_ranking import DOCS, PUPIL, frame_information
from codesign.batches.scenes import TEST, EyeScenes
from codesign.evaluate.tables import ratio
from codesign.optics import stack as optics
from codesign.optics.stack import Stack
from metalens.image import pupil, sensor

SIMPLE = ("hyper20", "hyper24", "hyper28", "hyper33", "hyper40", "helix2")
FRAMES = 16
SAMPLE_UM = 0.75


def free_form(path: Path) -> Stack:
    """PSFs of a saved design on the samples of the study; what falls out of the pupil
    model's period is lost.
    """
    settings = replace(optics_of("hyper20")[0], depth_count=48)
    held = np.load(path)
    size = optics.stack(settings, torch.zeros(0)).intensity.shape[-1]
    phase = torch.from_numpy(held["controls"].astype(float))
    samples = int(min(size * settings.sample_um, PUPIL.period_um) / SAMPLE_UM)
    fine = pupil.psf(phase, PUPIL, depths_um=settings.depths_um, focus_um=float(held["focus_um"]),
                     sample_um=SAMPLE_UM, samples=samples)  # fmt: skip
    pixels = sensor.integrate(
        fine, SAMPLE_UM, pitch_um=settings.sample_um, shape=(size, size)
    )
    return Stack(pixels, settings.depths_um)


def main() -> None:
    """Measure all lenses frame by frame, write ratios with intervals over the frames."""
    torch.set_num_threads(1)
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / "designs"
    frames = EyeScenes(SCENES, 9.0, 2000.0, 0, TEST).rendered(0, FRAMES).frames
    found: dict[str, torch.Tensor] = {}
    lenses: dict[str, Stack | None] = dict.fromkeys(SIMPLE)
    lenses |= {
        f"free form {path.stem}": free_form(path)
        for path in sorted(folder.glob("b*_0.50*.npz"))
    }
    values: dict[str, Any] = {
        "what": "noise-weighted Fisher information on depth of 16 frames per mm², with brightness, size, place and "
        "texture unknown; ratio to hyper20 and 95 % interval over the frames",
        "lenses": {},
    }
    for name, made in lenses.items():
        known = frame_information(
            "hyper20" if made is not None else name, frames, made=made
        )[1]
        found[name] = torch.tensor(known)
        compared = ratio(found[name], found["hyper20"])
        values["lenses"][name] = {
            "information_per_mm2": float(np.mean(known)),
            "ratio": list(compared),
        }
        print(name, values["lenses"][name], flush=True)
    (DOCS / "projected.json").write_text(json.dumps(values, indent=1) + "\n")


if __name__ == "__main__":
    main()
