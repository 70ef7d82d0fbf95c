"""Small lenses before few pixels, as benches of a budget; shared by the tests beside
it.
"""

import functools
from dataclasses import replace

import numpy as np

from codesign.budget.prepared import BudgetInputs, PreparedDevice, prepare_device
from codesign.budget.task import TaskSetting
from codesign.evaluate import ExperimentConfig
from codesign.optics import OpticsNumerics
from metalens import design
from metalens.cell import Cell, Film, Index
from metalens.design import Focus
from metalens.fabrication import Printed, Spread
from metalens.lens import Layers, Lens, NeighbourRows
from metalens.library.proxy import Proxy

SLOPE = 55.0  # rad a um: phase of a pillar over its diameter, a straight line
CELL = Cell(
    pitch_um=0.30, height_um=0.5, pillar=Index(1.7)
)  # solved fast; its phase is not that of the proxy
FOCUS = Focus(0.85, 300.0, 3000.0)
PROXY = Proxy(
    np.array([[0.145 * SLOPE, 0.065 * SLOPE]]), np.array([[0.9, -0.03]]), (0.08, 0.21), (0.85, 0.85), 0.0, 0.0
)  # fmt: skip
SETTING = TaskSetting(scenes=2, pixels=16, margin=3, pitch_um=4.1)
FRAMES = ExperimentConfig(
    subjects=1, grid=(4, 3), share=0.5, axial_mm=(-2.5,), lateral_mm=(1.5,), hidden=0
)
GIVEN = BudgetInputs(
    OpticsNumerics(4, 1, 1e-3, 1e-2), mask=Printed(spread=Spread.only(bias_nm=1.3, gradient_nm=0.9), diameter_step_nm=4.0),
    frames=FRAMES, draws=3,
)  # fmt: skip


ROWS = NeighbourRows(
    np.array([0.05, 0.11, 0.09]), np.array([False, False, True]),
    0.97 * np.exp(1j * np.array([[0.06, 0.17, 0.13], [0.05, 0.15, 0.11]])),
    0.96 * np.exp(1j * np.array([[0.04, 0.13, 0.12], [0.05, 0.12, 0.10]])),
    np.array([0.01, 0.03, 0.02]), 0.85,
)  # fmt: skip


@functools.cache
def lens(*, films: bool = False) -> Lens:
    """A hyperbolic lens of 48 um at f/6: bare, or between cover glass and filter with
    rows of unlike pillars.
    """
    focus = (
        replace(
            FOCUS,
            layers=Layers((Film(Index(1.45), 200.0),), (Film(Index(1.52), 45.0),)),
        )
        if films
        else FOCUS
    )
    wanted = design.phase_of(None, focus, radius_um=24.0)
    made = design.make(
        wanted, focus, aperture_um=48.0, cell=CELL, proxy=PROXY, profile="hyperbolic"
    )[0]
    return replace(made, neighbours=ROWS) if films else made


@functools.cache
def bare() -> PreparedDevice:
    """In light of one wavelength, without films."""
    return prepare_device(lens(), GIVEN, SETTING)


@functools.cache
def filmed() -> PreparedDevice:
    """In light of a diode, between films, with rows of unlike pillars."""
    return prepare_device(
        lens(films=True), replace(GIVEN, fwhm_nm=24.0, mask=None), SETTING
    )
