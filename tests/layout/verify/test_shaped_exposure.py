"""Doses of pillars of any shape on any lattice, exposed by a stranger: KLayout's
polygons, convolved and cut.
"""

import math

import numpy as np
import pytest

import layout
from layout.formats import job_files
from layout.process.process import DieSettings, ExposureSettings, Process
from layout.verify.exposure import verify_exposure
from layout.verify.written_lens import LensRows
from metalens.cell import Cell, Lattice
from metalens.cell.shapes import Circle, Cross, Ellipse, Polygon, Rectangle, Ring
from metalens.fabrication import Bias
from metalens.lens import DiameterMap, Lens
from tests.proxies import proxy_of
from tests.referees import plain_exposure
from tests.referees.verified import verify

pytest.importorskip("klayout.db")

PROXY = proxy_of([3.0, 3.0], [0.93], (0.05, 0.32), 0.94, 0.01)
UNEXPOSED = (2, 7, 10)  # aperture (another step), write fields, outline
ELL = Polygon(
    ((-0.5, -0.5), (0.5, -0.5), (0.5, -0.05), (0.0, 0.05), (-0.05, 0.5), (-0.5, 0.45))
)
HEX, LONG = Lattice("hexagonal"), Lattice("rectangular", 1.3)
CASES = {  # shape, lattice, sizes, turned, beam
    "hexagonal": (Circle(), HEX, (0.10, 0.26), False, (0.021, 3.3, 0.8)),
    "turned": (Rectangle(0.45), Lattice(), (0.22, 0.28), True, (0.017, 9.7, 0.6)),
    "triple": (Ellipse(0.6), LONG, (0.15, 0.27), True, (0.012, 7.1, 0.6, 1.1, 0.15)),
    "ring": (Ring(0.45), HEX, (0.22, 0.28), False, (0.014, 5.3, 0.7)),
    "cross": (Cross(0.4), LONG, (0.2, 0.3), False, (0.011, 4.1, 0.7)),
    "own": (ELL, Lattice(), (0.19, 0.28), False, (0.019, 3.9, 0.75)),
    "openings": (
        Rectangle(0.6, hole=True),
        HEX,
        (0.17, 0.25),
        False,
        (0.016, 6.1, 0.7),
    ),
}
NAMES = ("alpha_um", "beta_um", "eta", "gamma_um", "nu")


def corrected(source, process, **options):
    """The plan of a lens with a dose for every shape."""
    plan = layout.plan(source, process, **options)
    known = process.exposure.corrected
    return layout.correct(plan, process.exposure) if known else plan


def lens(shape, lattice, sizes, turned, empty=0.25):
    """Sizes at random on a round aperture off the centre, a share of the sites empty."""
    pitch, rng = 0.4, np.random.default_rng(23)
    # each turn has its own polygon
    rows, columns = (21, 33) if lattice.centred else (9, 11) if turned else (19, 17)
    row_um = 0.346 if lattice.centred else None
    d = np.rint(1e3 * rng.uniform(*sizes, (rows, columns))) * 1e-3
    y = np.arange(rows)[:, None] - (rows - 1) / 2
    x = np.arange(columns) - (columns - 1) / 2
    outside = (x / columns - 0.03) ** 2 + (y / rows + 0.02) ** 2 > 0.22
    d[outside | (rng.random(d.shape) < empty)] = 0
    if lattice.centred:
        d[(np.arange(rows)[:, None] + np.arange(columns)) % 2 == 1] = 0
    angle = rng.uniform(0, math.pi, d.shape) if turned else None
    cell = Cell(pitch, lattice=lattice, shape=shape)
    where = (lattice, row_um) if lattice.kind != "square" else ()
    made = DiameterMap(d, pitch, *where, angle_rad=angle)
    return Lens(
        made, cell, PROXY, 0.94, 77.0, math.inf, "map", hand="left" if turned else ""
    )


@pytest.mark.parametrize("case", CASES)
def test_every_shape_comes_out_with_its_area_and_the_certificate_says_how_nearly(
    tmp_path, case
):
    """1 nm of width is what is promised; pixels of a quarter of the core add 0.15 nm.

    The certificate is as near to the stranger as pixels and tables of areas are: 0.2 nm
    together (pixels of 2 and 4 nm
    in quarters meet edges on the grid).
    """
    *made, beam = CASES[case]
    exposure = ExposureSettings(**dict(zip(NAMES, beam, strict=False)))
    process = Process(exposure=exposure, die=DieSettings(margin_um=300))
    source = lens(*made)
    plan = corrected(source, process, furnished=False)
    layout.write_gdsii(plan, tmp_path / "m.gds")
    job_files.write_dose_table(plan, process, tmp_path / "doses.csv")
    found = certified(
        layout.read_gdsii(tmp_path / "m.gds"),
        plan,
        job_files.read_dose_table(tmp_path / "doses.csv"),
        process,
    )
    assert len(found) == plan.counts()[1:].sum()
    drawn = plain_exposure.shapes(tmp_path / "m.gds", tmp_path / "doses.csv", UNEXPOSED)
    terms = [(beam[0], 1.0), (beam[1], beam[2])] + ([beam[3:]] if len(beam) > 3 else [])
    resist = plain_exposure.Resist(drawn, terms)
    sites = places(plan)
    away = np.hypot(*(sites[:, :2] - sites[:, :2].mean(0)).T)
    some = np.r_[
        np.argsort(-away)[:3],
        np.random.default_rng(1).choice(len(sites), 3, replace=False),
    ]
    for x, y, number in sites[some].tolist():
        cls = plan.classes[int(number) - 1]
        area = cls.twice_area / 2e6
        around = sum(length(c) for c in cls.contours) / 1e3
        got = resist.cleared_um2(
            np.array([x, y]), 0.2, 0.002 if beam[0] < 0.016 else 0.004
        )
        wider_nm = (got - area) / around * 2e3
        assert abs(wider_nm) < 1.15, (x, y, cls.name)
        told = found[np.hypot(found[:, 0] - x, found[:, 1] - y).argmin(), 2]
        size = 2e3 * math.sqrt(area / math.pi) if cls.round else cls.diameter_nm
        assert abs(told - size - wider_nm) < 0.2, (x, y, cls.name)


@pytest.mark.parametrize("lattice", [Lattice(), HEX], ids=lambda one: one.kind)
def test_the_lens_as_made_holds_shapes_whose_middle_lies_beside_their_site(
    tmp_path, lattice
):
    """The middle of a triangle is the mean of its corners: here (0.1, -0.1) sizes off,
    32 nm at a pitch of 400 nm.
    """
    corner = Polygon(((-0.4, -0.5), (0.6, -0.5), (0.1, 0.7)))
    assert np.mean(corner.corners, axis=0) == pytest.approx([0.1, -0.1])
    process = Process(exposure=ExposureSettings(alpha_um=0.019, beta_um=3.9, eta=0.75))
    source = lens(corner, lattice, (0.22, 0.226), turned=False)
    plan = corrected(source, process, furnished=False)
    layout.write_oasis(plan, tmp_path / "m.oas")
    job_files.write_dose_table(plan, process, tmp_path / "doses.csv")
    rows = LensRows(plan)
    verify_exposure(
        layout.read_oasis(tmp_path / "m.oas"),
        plan,
        job_files.read_dose_table(tmp_path / "doses.csv"),
        process,
        keep=rows.take,
    )
    made = rows.lens(source).diameters.diameter_um
    want = source.diameters.diameter_um
    assert np.array_equal(made > 0, want > 0)
    # 1 nm of the step of sizes, 1 nm of the exposure, the grid
    assert abs(made - want).max() < 2.1e-3


def certified(content, plan, table, process):
    """(n, 3) x, y and size in the resist of every pillar by the certificate, which
    holds.
    """
    found = verify(plan, content, table, process)
    outcome = found.report
    assert outcome.ok, (outcome.worst_exposure, outcome.worst_nm)
    return np.column_stack([found.x_um, found.y_um, found.resist_nm])


def places(plan):
    """(n, 3) x, y in um and class number of every pillar of the lens."""
    l = plan.lattices[0]
    rows, columns = np.nonzero(l.whole())
    x = (l.x0 + columns * l.pitch) / 1e3
    y = (l.y0 - rows * l.down) / 1e3
    return np.column_stack([x, y, l.whole()[rows, columns]])


def length(contour):
    return float(np.hypot(*(np.roll(contour, -1, axis=0) - contour).T).sum())


@pytest.mark.parametrize("case", ["hexagonal", "turned"])
def test_lone_pillars_of_any_shape_and_lattice_come_out_as_designed(tmp_path, case):
    """Pillars of the rim lack neighbours, worth up to 8 nm: the mask makes up for it,
    by sums over the sites, and the
    certificate finds the designed sizes, by pixels over the mask."""
    *made, beam = CASES[case]
    exposure = ExposureSettings(**dict(zip(NAMES, beam, strict=False)))
    process = Process(
        exposure=exposure,
        die=DieSettings(margin_um=300),
        bias=Bias(isolated_nm=-12.0, range_um=1.1),
    )
    source = lens(*made, empty=0.0)
    plan = corrected(source, process, furnished=False)
    layout.write_gdsii(plan, tmp_path / "m.gds")
    job_files.write_dose_table(plan, process, tmp_path / "doses.csv")
    content = layout.read_gdsii(tmp_path / "m.gds")
    table = job_files.read_dose_table(tmp_path / "doses.csv")
    found, d = verify(plan, content, table, process), source.diameters
    x, y, size = found.x_um, found.y_um, found.made_nm
    row = np.rint(y / d.steps_um[1] + (len(d.y_um) - 1) / 2)
    column = np.rint(x / d.steps_um[0] + (len(d.x_um) - 1) / 2)
    off = size - 1e3 * d.diameter_um[row.astype(int), column.astype(int)]
    # 1 nm of the step, 1 nm of the exposure, 0.3 nm between pixels and sums
    assert np.abs(off).max() < 2.3, (np.abs(off).max(), np.abs(off).mean())
