"""A small lens, a fit of it written down by hand, and a finished run of it; shared by
the tests beside it.
"""

import functools
import json
import math
from dataclasses import replace

import numpy as np

from characterize.inference.asbuilt import AsBuilt
from characterize.model.parameters import NAMES, PLACE, parameter_vector
from codesign.network.architecture import smallest_architecture
from codesign.optics.as_built_lens import OF_PROCESS
from codesign.optics.stack import OpticsConfig
from codesign.train import evolution, run
from codesign.train.evolution import EvaluatedCandidate, EvolutionState
from metalens import design, lens
from metalens.cell.record import Cell, Index
from metalens.core.store import Provenance
from metalens.design.profiles import Focus
from metalens.fabrication import proxy_sensitivity
from tests.proxies import proxy_of

# phase of 3 turns over the domain, with a wavelength so that a change of it is felt;
# |T| of 0.9 that varies a little
PROXY = proxy_of([6.0, 3 * math.pi], [0.9, -0.03], (0.08, 0.32), 0.85, 1e-6)
CELL = Cell(pitch_um=0.4, pillar=Index(3.6), substrate=Index(1.45))
TRUE = {
    "bias_nm": 6.0,
    "bias_x_nm": 4.0,
    "bias_r_nm": 3.0,
    "height_nm": -8.0,
    "distance_um": 3.0,
    "coma_x_rad": 0.2,
}
TINY = """
preset = "smoke"
validation_batches = 1
test_batches = 1
[scenes]
pixels = 48
margin = 4
[inner]
steps = 1
batch = 8
[inner.optics]
rate = 0.0
[search]
population = 2
tournament = 1
rounds = 2
[optics]
image = "uniform"
aperture_mm = 0.12
sensor_distance_mm = 0.3
focus_mm = 3.0
depths_mm = [12.0, 40.0]
depth_count = 3
sample_um = 3.0
window_samples = 11
polynomials = 0
[space]
widths = [0.25]
depths = [2]
[run]
budgets_mmacs = [2.0]
pitch_um = 3.0
"""
OPTICS = OpticsConfig(
    0.12, 0.3, 850.0, 3.0, 0, 0, (2.0, 6.0), 3, 3.0, 11, image="uniform"
)
SEEN = replace(OPTICS, depths_mm=(12.0, 40.0))  # of TINY, where eyes are


def at_rest(x):
    """Parameters of process and sensor distance; the others at their defaults."""
    kept = [*OF_PROCESS, PLACE["distance_um"]]
    rest = parameter_vector()
    rest[kept] = x[kept]
    return rest


@functools.lru_cache
def small() -> lens.Lens:
    """A hyperbolic lens of 120 um."""
    focus = Focus(0.85, 300.0, 3000.0)
    phase = design.phase_of(None, focus, radius_um=60.0)
    return design.make(phase, focus, aperture_um=120.0, cell=CELL, proxy=PROXY)[0]


def asbuilt(problems=(), sigma=0.1, made=None) -> AsBuilt:
    """A fit that found TRUE; one frame of nothing stands in for the captures."""
    names = tuple(name for name in NAMES if name in TRUE)
    blank = np.zeros((1, 2, 2))
    covariance = np.eye(len(names)) * sigma**2
    return AsBuilt(
        design=made or small(),
        response=proxy_sensitivity(small()),
        names=names,
        value=np.array([TRUE[n] for n in names]),
        covariance=covariance,
        information=np.linalg.inv(covariance),
        fixed={},
        depth_um=np.array([3000.0]),
        angle_rad=np.zeros((1, 2)),
        pixel_um=3.0,
        measured=blank,
        predicted=blank,
        nominal=blank,
        residual_sigma=blank,
        chi2_per_dof=1.0,
        converged=True,
        reason="by hand",
        problems=tuple(problems),
        provenance=Provenance(),
    )


def finished_run(folder, text=TINY):
    """The files of a run whose search ended, its network untrained."""
    folder.mkdir(parents=True)
    (folder / "run.toml").write_text(text)
    settings = run.load_run_settings(folder / "run.toml")
    going = run.start_run(settings)
    chosen = smallest_architecture(settings.space)
    going.searches = [
        EvolutionState((EvaluatedCandidate(chosen, 1.0, going.macs(chosen)),), {})
    ]
    run.save_run(folder / "checkpoint.safetensors", going)
    row = {"budget_mmacs": 2.0, "mmacs": 1.0}
    row["architecture"] = evolution.state_to_json(going.searches[0])["history"][0]
    (folder / "result.json").write_text(json.dumps({"rows": [row]}))
    lens.save(folder / "lens.h5", small())
    return settings
