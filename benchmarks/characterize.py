"""Captures to the as-built lens: real beads, errors against the Cramér-Rao bound, the reduced model, micrographs."""

import sys
import time
from pathlib import Path

import numpy as np

from benchmarks import Row, fastest
from characterize import bench, capture, sem
from characterize.forward import ForwardModel, Setting
from characterize.parameters import vector
from characterize.pupil import PupilSpec
from characterize.pupilfit import fit_pupil

ROOT = Path(__file__).parents[1]
BEADS = ROOT.parent / "shared" / "captures" / "bead_stack" / "psf_wl520nm_z300nm_x130nm_na0.85_n1.0.tif"
sys.path.insert(0, str(ROOT / "tests" / "characterize"))


def rows() -> list[Row]:
    """All rows; a hundred hidden lenses are in ``characterize_study``."""
    return [
        *_beads(),
        *_reduced(),
        *_micrographs(),
    ]


def _beads() -> list[Row]:
    if not BEADS.is_file():
        return []
    shots = capture.load(BEADS)
    start = time.perf_counter()
    found = fit_pupil(shots, PupilSpec(0.85, 0.52, 0.13, step_um=0.3))
    seconds = time.perf_counter() - start
    score = found.held_out
    if score is None:
        return []
    about = "12 odd planes predicted from 13 even ones, 40 x 40 crop"
    return [
        Row("bead stack, NRMSE", "vectorial pupil", seconds, score.nrmse, about, goal="<= 0.20 (best known 0.279)"),
        Row(
            "bead stack, 1 - NCC", "vectorial pupil", seconds, 1 - score.ncc, about, goal="<= 0.025 (best known 0.053)"
        ),
        Row("bead stack, 1 - mean NCC of planes", "vectorial pupil", seconds, 1 - score.plane_ncc, about),
    ]


def _reduced() -> list[Row]:
    import bench_lens as b

    setting = Setting(np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16)
    model = ForwardModel(b.lens(), setting, b.RESPONSE)
    x = vector(b.VALUES | {"background_e": 0.0, "background_x_e": 0.0})
    start = time.perf_counter()
    want = bench.irradiance(b.lens(), b.truth(), b.RESPONSE)
    full = time.perf_counter() - start
    found = model.images(x)[0]
    scale = (found * want).sum() / (found**2).sum()
    error = float(np.abs(scale * found - want).max() / want.max())
    quick = fastest(lambda: model.images(x))
    about = "sum over every pillar, share of the peak"
    return [
        Row("5 frames, 40 um lens", "every pillar", full, float("nan"), "is the reference"),
        Row(
            "5 frames, 40 um lens",
            "reduced model",
            quick,
            error,
            about,
            goal=f"<= 1e-3; {full / quick:.0f} times faster",
        ),
    ]


def _micrographs() -> list[Row]:
    import test_sem

    truth = np.random.default_rng(1).uniform(140, 300, (4, 4))
    start = time.perf_counter()
    pictures = [test_sem.render(truth, seed) for seed in range(8)]
    drawn = time.perf_counter() - start
    start = time.perf_counter()
    found = np.array([sem.measure(p, test_sem.ABOUT).diameter_nm for p in pictures]) / test_sem.PIXEL
    seconds = (time.perf_counter() - start) / len(pictures)
    error = found - truth.ravel() / test_sem.PIXEL
    about = f"drawn diameters, pixels (drawing took {drawn:.1f} s)"
    return [
        Row("micrograph of 16 pillars", "bias", seconds, float(error.mean()), about, goal="<= 0.3 px"),
        Row(
            "micrograph of 16 pillars",
            "repeatability",
            seconds,
            float(error.std(0, ddof=1).mean()),
            about,
            goal="<= 0.1 px",
        ),
    ]
