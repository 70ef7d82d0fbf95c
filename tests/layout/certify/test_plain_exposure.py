"""A corrected mask exposed by a stranger: files read by KLayout, convolved on pixels, cut at the threshold."""

import numpy as np
import pytest

import layout
from layout.files import doses
from layout.mask import build
from layout.process.process import Exposure, Process
from metalens.lens.record import DiameterMap
from tests.referees import plain_exposure

pytest.importorskip("klayout.db")

UNEXPOSED = (2, 7, 10)  # aperture (another step), write fields, outline


def lens_map(n, pitch, low, high, share):
    """Round, off centre, of random diameters; ``share`` of its sites hold a pillar."""
    axis, rng = np.arange(n) - (n - 1) / 2, np.random.default_rng(n)
    d = rng.uniform(low, high, (n, n))
    d[((axis - 1) ** 2 + axis[:, None] ** 2 > (n / 2.2) ** 2) | (rng.random((n, n)) > share)] = 0
    return DiameterMap(d, pitch)


@pytest.mark.parametrize(
    ("beam", "source"),
    [
        ({"alpha_um": 0.041, "beta_um": 3.1, "eta": 0.8}, (41, 0.4, 0.11, 0.29, 1.0)),
        ({"alpha_um": 0.013, "beta_um": 9.7, "eta": 0.6, "gamma_um": 1.2, "nu": 0.12}, (37, 0.35, 0.09, 0.24, 0.6)),
    ],
)
def test_every_pillar_comes_out_at_its_size(tmp_path, beam, source):
    """1 % and 1 nm; pixels of a quarter of the core, in ninths, and polygons for circles add 0.3 % and 0.1 nm."""
    process = Process(exposure=Exposure(**beam))
    plan = build.prepare(lens_map(*source), process, furniture="none").plan
    layout.write_gdsii(plan, tmp_path / "m.gds")
    doses.write(plan, process, tmp_path / "doses.csv")
    drawn = plain_exposure.shapes(tmp_path / "m.gds", tmp_path / "doses.csv", UNEXPOSED)
    assert len(drawn) == plan.counts()[1:].sum()
    terms = [(beam["alpha_um"], 1.0), (beam["beta_um"], beam["eta"])]
    terms += [(beam["gamma_um"], beam["nu"])] if "gamma_um" in beam else []
    resist = plain_exposure.Resist(drawn, terms)
    at = np.array([shape.middle for shape in drawn])
    rim = np.argsort(-np.hypot(*(at - at.mean(0)).T))[:4]  # where the background falls
    some = np.concatenate([rim, np.random.default_rng(1).choice(len(drawn), 6, replace=False)])
    for number in some.tolist():
        edge, made = resist.pillar(number, min(beam["alpha_um"] / 4, 0.004))
        assert abs(edge - 1) < 0.013, at[number]
        assert abs(made - drawn[number].diameter_um) < 1.1e-3, at[number]
