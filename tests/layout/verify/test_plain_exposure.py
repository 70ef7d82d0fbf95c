"""A corrected mask exposed by a stranger: files read by KLayout, convolved on pixels,
cut at the threshold.
"""

import numpy as np
import pytest
from matplotlib.path import Path as Outline

import layout
from layout.formats import job_files
from layout.process.process import DieSettings, ExposureSettings, Process
from metalens.lens.record import DiameterMap
from tests.referees import plain_exposure
from tests.referees.verified import verify

pytest.importorskip("klayout.db")

UNEXPOSED = (2, 7, 10)  # aperture (another step), write fields, outline


def corrected(source, process, **options):
    """The plan of a lens with a dose for every shape."""
    plan = layout.plan(source, process, **options)
    known = process.exposure.corrected
    return layout.correct(plan, process.exposure) if known else plan


def lens_map(n, pitch, low, high, share):
    """Round, off centre, of random diameters; ``share`` of its sites hold a pillar."""
    axis, rng = np.arange(n) - (n - 1) / 2, np.random.default_rng(n)
    d = rng.uniform(low, high, (n, n))
    d[
        ((axis - 1) ** 2 + axis[:, None] ** 2 > (n / 2.2) ** 2)
        | (rng.random((n, n)) > share)
    ] = 0
    return DiameterMap(d, pitch)


def of_two_sizes(made, low, high):
    """The thinnest and the widest pillars alone: dose test and witness cells repeat
    every size of a lens.
    """
    d = made.diameter_um
    return DiameterMap(
        np.where(d > 0, np.where(d < (low + high) / 2, low, high), 0.0), made.pitch_um
    )


@pytest.mark.parametrize(
    ("beam", "source"),
    [
        ({"alpha_um": 0.041, "beta_um": 3.1, "eta": 0.8}, (29, 0.4, 0.11, 0.29, 1.0)),
        (
            {
                "alpha_um": 0.013,
                "beta_um": 9.7,
                "eta": 0.6,
                "gamma_um": 1.2,
                "nu": 0.12,
            },
            (29, 0.35, 0.09, 0.24, 0.6),
        ),
    ],
)
def test_every_pillar_comes_out_at_its_size(tmp_path, beam, source):
    """1 % and 1 nm; pixels of a quarter of the core, in sixteenths, and polygons for
    circles add 0.3 % and 0.1 nm.
    """
    process = Process(exposure=ExposureSettings(**beam))
    plan = corrected(lens_map(*source), process, furnished=False)
    layout.write_gdsii(plan, tmp_path / "m.gds")
    job_files.write_dose_table(plan, process, tmp_path / "doses.csv")
    drawn = plain_exposure.shapes(tmp_path / "m.gds", tmp_path / "doses.csv", UNEXPOSED)
    assert len(drawn) == plan.counts()[1:].sum()
    terms = [(beam["alpha_um"], 1.0), (beam["beta_um"], beam["eta"])]
    terms += [(beam["gamma_um"], beam["nu"])] if "gamma_um" in beam else []
    resist = plain_exposure.Resist(drawn, terms)
    at = np.array([shape.middle for shape in drawn])
    rim = np.argsort(-np.hypot(*(at - at.mean(0)).T))[:4]  # where the background falls
    some = np.concatenate(
        [rim, np.random.default_rng(1).choice(len(drawn), 6, replace=False)]
    )
    for number in some.tolist():
        edge, made = resist.pillar(number, min(beam["alpha_um"] / 4, 0.004))
        assert abs(edge - 1) < 0.013, at[number]
        assert abs(made - drawn[number].diameter_um) < 1.1e-3, at[number]


@pytest.mark.parametrize(
    ("alpha_um", "beta_um", "eta", "thinnest_um"),
    [
        (0.008, 3.7, 0.9, 0.11),
        pytest.param(0.041, 3.1, 0.8, 0.11, marks=pytest.mark.slow),
        pytest.param(0.06, 2.9, 0.7, 0.25, marks=pytest.mark.slow),
    ],
)
def test_edges_of_marks_verniers_and_labels_are_exposed_as_the_certificate_says(
    tmp_path, alpha_um, beta_um, eta, thinnest_um
):
    """Points on crosses, verniers, box and letters by plain convolution: 0.3 % and 0.1
    nm (pixels, rasters).

    All along them 1 % and 1 nm hold, also for backscatter as short as a stroke and a
    core half as wide as a pillar.
    """
    beam = {"alpha_um": alpha_um, "beta_um": beta_um, "eta": eta}
    process = Process(
        exposure=ExposureSettings(**beam),
        die=DieSettings(margin_um=330, mark_um=40, label="R4"),
    )
    made = of_two_sizes(lens_map(29, 0.4, thinnest_um, 0.29, 0.7), thinnest_um, 0.29)
    plan = corrected(made, process)
    layout.write_gdsii(plan, tmp_path / "m.gds")
    job_files.write_dose_table(plan, process, tmp_path / "doses.csv")
    drawn = plain_exposure.shapes(tmp_path / "m.gds", tmp_path / "doses.csv", UNEXPOSED)
    resist = plain_exposure.Resist(
        drawn, [(beam["alpha_um"], 1.0), (beam["beta_um"], beam["eta"])]
    )
    found = verify(
        plan,
        layout.read_gdsii(tmp_path / "m.gds"),
        job_files.read_dose_table(tmp_path / "doses.csv"),
        process,
    ).report.edges
    assert set(found.layer.tolist()) == {
        process.layers.marks[0],
        process.layers.labels[0],
    }
    assert abs(found.exposure - 1).max() < 0.01
    assert 2 * np.abs(found.shift_nm).max() < 1
    rng = np.random.default_rng(4)
    each = [
        np.flatnonzero(found.layer == layer)
        for layer in sorted(set(found.layer.tolist()))
    ]
    picked = np.concatenate([rng.choice(some, 4, replace=False) for some in each])
    worst = np.argsort(-abs(found.exposure - 1))[:3]
    around = np.array([(s.corners.min(0) - 0.1, s.corners.max(0) + 0.1) for s in drawn])
    for n in [*picked.tolist(), *worst.tolist()]:
        at = np.array([found.x_um[n], found.y_um[n]])
        edge, shift = resist.edge(
            at, outward(drawn, around, at), min(0.004, alpha_um / 4)
        )
        assert abs(edge - found.exposure[n]) < 0.003, at
        assert abs(shift * 1e3 - found.shift_nm[n]) < 0.1, at
        assert abs(edge - 1) < 0.013, at


def outward(drawn, around, at):
    """Across the edge through a point: no shape lies on that side of it. around: (n, 2,
    2) boxes of the shapes.
    """
    near = [
        drawn[n]
        for n in np.flatnonzero(((around[:, 0] < at) & (at < around[:, 1])).all(1))
    ]
    free = []
    for across in np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]):
        beside = [
            at + 0.02 * across + aside * across[::-1] for aside in (-0.005, 0.005)
        ]
        if not any(Outline(s.corners).contains_points(beside).any() for s in near):
            free.append(across)
    assert len(free) == 1
    return free[0]
