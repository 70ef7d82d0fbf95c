"""The error budget: phases of pillars in closed form, sums in quadrature, and a run
whose budget ends where the virtual experiment does.
"""

import functools
import json
import math

import numpy as np
import pytest

from codesign.adapt import source as finished
from codesign.commands import budget as command
from codesign.evaluate import error_budget, gaze_experiment
from codesign.evaluate.error_budget import TOTAL, BudgetEntry, BudgetInputs, ErrorBudget
from codesign.optics import MadeLens, OpticsConfig
from codesign.optics.stack import lens_settings
from codesign.settings import ExperimentConfig
from metalens import design, lens
from metalens.cell import Cell, Film, Index
from metalens.core.errors import LensError
from metalens.design import Focus
from metalens.fabrication import Spread, State, draw_lenses
from metalens.image import with_psfs
from metalens.optics import Layers
from tests.codesign import made_lens as m
from tests.command_line import call
from tests.proxies import proxy_of

SLOPE = 55.0  # rad / um: phase over diameter, a straight line
CELL = Cell(pitch_um=0.30, height_um=0.5, pillar=Index(1.7))
PROXY = proxy_of([0.145 * SLOPE, 0.065 * SLOPE], [0.9, -0.03], (0.08, 0.21), 0.85)
FILMS = Layers((Film(Index(1.45), 200.0),), (Film(Index(1.52), 180.0),))
FRAMES = ExperimentConfig(
    subjects=2, grid=(4, 3), share=0.3, axial_mm=(-2.5, 1.5), lateral_mm=(1.5,),
    people=9,
)  # fmt: skip


@functools.cache
def small(films=False):
    """A hyperbolic lens of 48 um at f/6; or one of 120 um, between cover glass and
    filter and so far from the sensor that its field is within 35 degrees.
    """
    focus, radius = Focus(0.85, 300.0, 3000.0), 24.0
    if films:
        focus, radius = Focus(0.85, 1200.0, 12e3, layers=FILMS), 60.0
    wanted = design.phase_of(None, focus, radius_um=radius)
    about = {"aperture_um": 2 * radius, "cell": CELL, "proxy": PROXY}
    return design.make(wanted, focus, profile="hyperbolic", **about)[0]


def scatter(made, states):
    """rms over states of the phase scatter of a lens's pillars."""
    open_ = made.design.diameters.diameter_um > 0
    base = made.pillars(State.of()).numpy()[open_]
    turns = [
        error_budget.scatter_rad(made.pillars(state).numpy()[open_], base)
        for state in states
    ]
    return np.sqrt(np.mean(np.square(turns)))


def test_the_phase_of_a_process_is_that_of_the_slope_of_the_pillars():
    """A gradient of g from edge to edge turns a pillar at u of the radius by slope g u /
    2, and u has the deviation 1/2 over a disc; a common bias turns all alike.
    """
    made = MadeLens(small(), lens_settings(small(), 0.0))
    want = SLOPE * 1.7e-3 / 4
    spread = Spread.only(gradient_nm=1.7)
    got = scatter(made, [d.state() for d in draw_lenses(spread, 400, seed=2)])
    # 400 draws: 4 sigma are 0.14; pillars at the rim 0.02
    assert got == pytest.approx(want, rel=0.16)
    assert scatter(made, [State.of({"bias_nm": 1.7})]) < 0.05 * want


@pytest.mark.parametrize(
    ("off", "refused"),
    [((1.019, 1, 1), False), ((1.021, 1, 1), True), ((1, 0.979, 1), True),
     ((1, 1, 1.021), True), ((1, 1, 0.981), False)],
)  # fmt: skip
def test_a_network_of_another_lens_is_refused_beyond_two_per_cent(off, refused):
    """Sensor distance, wavelength and aperture of the run against those of the lens."""
    made = small()
    aperture = 2e-3 * made.diameters.radius_um
    its = OpticsConfig(
        aperture / off[2], 0.3 / off[0], 850.0 / off[1], 3.0, polynomials=0
    )
    if refused:
        with pytest.raises(LensError, match="trained for another lens"):
            error_budget.refuse_other_lens(made, its)
    else:
        error_budget.refuse_other_lens(made, its)


def test_a_sum_leaves_out_what_does_not_count_and_says_what_is_not_known():
    nan = math.nan
    rows = [
        BudgetEntry("a", 0.3, nan, 0.03, ""),
        BudgetEntry("b", nan, 0.2, 0.04, ""),
        BudgetEntry("c", 0.4, 0.1, nan, ""),
        BudgetEntry("d", 5.0, 5.0, 5.0, "", counted=False),
    ]
    total = error_budget.quadrature_total(rows)
    assert total.phase_rad == pytest.approx(0.5)
    assert total.psf == pytest.approx(math.sqrt(0.05))
    assert total.gaze_rad == pytest.approx(0.05)
    assert "gaze without c" in total.method


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("budget") / "run"
    m.finished_run(folder)
    return folder


def test_the_path_from_the_pupil_ends_where_the_experiment_does(run):
    """The last state is the experiment itself: the same people, frames and noise; the
    causes on the way add up to it, in quadrature, as far as each made the error grow.
    """
    source = finished.load_finished_run(run)
    budget = ErrorBudget(m.small(), BudgetInputs(run=source, frames=FRAMES, draws=2))
    rows = list(budget.reading.path(budget.smooth, budget.settings))
    measured = math.degrees(budget.reading.measured_rad)
    (*_, (_, (shown,))) = gaze_experiment.run_experiment([source], FRAMES)
    want = shown.gaze(gaze_experiment.AXIAL)
    assert measured == pytest.approx(want, rel=1e-6)
    counted = [row.gaze_rad for row in rows if row.counted]
    assert [row.link for row in rows] == [
        "subject and calibration",
        "reader",
        "sensor noise",
        "image of training",
    ]
    assert math.degrees(math.hypot(*counted)) >= measured * (1 - 1e-9)
    whole = budget.image
    assert error_budget.image_difference(whole, whole) == 0.0
    assert budget.reading.turn_rad(whole, whole) == 0.0
    rows, columns = (n // 2 for n in whole.stack.shape[:2])
    middle = whole.stack[rows, columns].expand_as(whole.stack).contiguous()
    assert budget.reading.turn_rad(with_psfs(whole, middle, whole.energy), whole) > 0


def test_the_command_writes_a_table_a_page_and_a_chart(tmp_path, capsys):
    lens.save(tmp_path / "lens.h5", small(films=True))
    words = f"budget {tmp_path}/lens.h5"
    assert call(f"{words} -o {tmp_path}/b.h5 --json") in (0, 1)
    told = json.loads(capsys.readouterr().out)
    rows = {row.link: row for row in command.load_budget(tmp_path / "b.h5")}
    assert [row["link"] for row in told["rows"]] == list(rows)
    assert told["gaze_error_deg"] is None
    assert told["psf_error"] == pytest.approx(rows[TOTAL].psf)
    assert rows["glass"].psf > 0.01  # 180 um of glass move the focus by 62 um
    assert math.isnan(rows["glass"].phase_rad)
    assert "no run was given" in rows["reader"].method
    parts = [row for link, row in rows.items() if link != TOTAL]
    for name in ("phase_rad", "psf"):
        known = [v for row in parts if math.isfinite(v := getattr(row, name))]
        assert getattr(rows[TOTAL], name) == pytest.approx(math.hypot(*known))
    assert "pillar solver and proxy" in (tmp_path / "b.html").read_text()
    assert (tmp_path / "b.png").stat().st_size > 1000
