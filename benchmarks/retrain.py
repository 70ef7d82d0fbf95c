"""PSFs of made lenses for training: time and error against every pillar; what the study
of hidden lenses kept.
"""

import json
import time

import numpy as np

from benchmarks import Row, fastest
from benchmarks.retrain_study import RESULT
from characterize.model import made
from characterize.model.parameters import PLACE, vector
from codesign.optics.built import MadeLens, of_lens
from codesign.optics.stack import OpticsConfig
from metalens import design, library, psf
from metalens.made import sensitivity
from metalens.psf import metrics as psf_metrics

SETTINGS = OpticsConfig(
    aperture_mm=0.4,
    focus_mm=28.0,
    polynomials=0,
    sample_um=18.0,
    window_samples=17,
    depth_count=6,
)
TRUE = {
    "bias_nm": 5.0,
    "bias_x_nm": 3.0,
    "bias_r_nm": 4.0,
    "height_nm": -8.0,
    "coma_x_rad": 0.3,
    "spherical_rad": 0.2,
}


def rows() -> list[Row]:
    """The quick stack against the PSF engine, and the summary of the study."""
    return [*_stacks(), *_study()]


def _stacks() -> list[Row]:
    swept = library.sweep(library.DEFAULT_CELL, wavelengths_um=(0.85,))
    phase = design.phase_of(None, SETTINGS.focus, radius_um=200.0)
    lens = design.make(
        phase,
        SETTINGS.focus,
        aperture_um=400.0,
        cell=swept.cell,
        proxy=library.proxy_of(swept),
    )[0]
    x, response = of_lens(vector(TRUE)), sensitivity(lens)
    ready = MadeLens(lens, SETTINGS, response=response)
    quick = fastest(lambda: ready.stack(x))
    start = time.perf_counter()
    t = made.pillars(lens, response, x)
    fine, window = 15 * 21, 18.0 * 21
    found = psf.psf_stack(
        np.angle(t).astype(np.float32),
        np.abs(t).astype(np.float32),
        pitch_um=lens.diameters.pitch_um,
        wavelength_um=lens.wavelength_um,
        sensor_distance_um=lens.sensor_distance_um + float(x[PLACE["distance_um"]]),
        depths_um=SETTINGS.depths_um.numpy(),
        window_um=window,
        samples=fine,
        tolerance=1e-3,
    )
    full = time.perf_counter() - start
    got = ready.stack(x).intensity.double().numpy()
    shift = np.stack(
        [_centre(got, 18.0)[i] - psf_metrics.centroid(found)[i] for i in (0, 1)]
    )
    case = f"{int((lens.diameters.diameter_um > 0).sum()) / 1e6:.1f} million pillars, 6 depths"
    about = "centre of the light against the engine over all pillars, um"
    return [
        Row(
            case,
            "every pillar, PSF engine",
            full,
            found.error,
            "its own estimate, relative L2",
        ),
        Row(
            case,
            "pillars gathered on the pupil",
            quick,
            float(np.abs(shift).max()),
            about,
            goal=f"{full / quick:.0f} times faster",
        ),
    ]


def _centre(light: np.ndarray, step_um: float) -> tuple[np.ndarray, np.ndarray]:
    place = (np.arange(light.shape[-1]) - (light.shape[-1] - 1) / 2) * step_um
    total = light.sum((1, 2))
    return (light.sum(1) * place).sum(1) / total, (light.sum(2) * place).sum(1) / total


def _study() -> list[Row]:
    if not RESULT.is_file():
        return []
    out = []
    for kind, told in json.loads(RESULT.read_text("utf-8")).items():
        if kind not in ("quick", "complete"):
            continue
        case = (
            f"{told['with_a_gap']} of {told['cases']} hidden lenses have a gap, {kind}"
        )
        gap = f"gap to the nominal lens, median {told['median_gap_mm']:.2f} mm"
        shares = {
            "share won back, median": (told["median_recovered"], ">= 0.90"),
            "share won back, worst tenth": (told["worst_tenth_recovered"], ">= 0.80"),
            "share won back, all lenses together": (told["pooled_recovered"], ""),
            "of what the truth would win, median": (
                told["median_recovered_of_what_the_truth_wins"],
                "",
            ),
            "parameters covered by 95 % intervals": (
                told.get("covered_95"),
                "0.92 to 0.98",
            ),
        }
        rows = [
            (what, value, goal)
            for what, (value, goal) in shares.items()
            if value is not None
        ]
        out += [
            Row(case, what, float("nan"), value, gap, goal=goal)
            for what, value, goal in rows
        ]
    return out
