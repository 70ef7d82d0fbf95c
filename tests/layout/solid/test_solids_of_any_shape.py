"""Solids of pillars of any shape, turn and lattice: volumes in closed form, places of
the sites, read back whole.
"""

import dataclasses
import math

import numpy as np
import pytest

from layout.process.process import Etch, Process
from layout.solid import mesh, readback, readback_meshes, verbs
from layout.solid.sections import Section
from metalens.cell import Cell, Lattice
from metalens.cell.shapes import Circle, Cross, Ellipse, Polygon, Rectangle, Ring
from metalens.ground.errors import ProcessError
from metalens.lens import DiameterMap, Lens, Pairs
from metalens.made import Bias
from metalens.pillars import Proxy

PROXY = Proxy(
    np.array([[3.0, 3.0]]), np.array([[0.93]]), (0.05, 0.32), (0.94, 0.94), 0.01, 0.01
)
LEAN = 0.7 * math.tan(
    math.radians(1.3)
)  # um that both edges together move from half height to the foot
TILTED = Process(etch=Etch(sidewall_deg=1.3))
U = Polygon(
    (
        (-0.5, -0.45),
        (0.5, -0.35),
        (0.5, 0.5),
        (0.2, 0.5),
        (0.2, 0.0),
        (-0.2, -0.1),
        (-0.25, 0.4),
        (-0.5, 0.4),
    ),
    0.2,
)


def lens(shape, kind="square", *, turned=False):
    rng, lattice = (
        np.random.default_rng(7),
        Lattice(kind, 1.15 if kind == "rectangular" else 1.0),
    )
    size = rng.choice([0.0, 0.2, 0.26], (6, 9))
    if lattice.centred:
        size[np.add.outer(np.arange(6), np.arange(9)) % 2 == 1] = 0
    angle = np.radians(rng.integers(0, 40, size.shape)) if turned else None
    grid = DiameterMap(size, 0.42, lattice, angle_rad=angle)
    return Lens(
        grid,
        Cell(0.42, shape=shape, lattice=lattice),
        PROXY,
        0.94,
        77.0,
        math.inf,
        "map",
        hand="left" if turned else "",
    )


def simpson(area):
    """Volume of what is LEAN wider at the foot than at half height and as much narrower
    at the top; exact to cubics.
    """
    return 0.7 / 6 * (area(LEAN) + 4 * area(0.0) + area(-LEAN))


AREAS = {
    "ring": lambda d: lambda g: math.pi / 4 * ((d + g) ** 2 - (0.5 * d - g) ** 2),
    "ellipse": lambda d: lambda g: math.pi / 4 * (d + g) * (0.6 * d + g),
    "cross": lambda d: lambda g: 2 * (d + g) * (0.4 * d + g) - (0.4 * d + g) ** 2,
    "rectangle": lambda d: lambda g: (d + g) * (0.55 * d + g),
}
CASES = [
    (Ring(0.5), "hexagonal", False),
    (Ellipse(0.6, 0.3), "square", False),
    (Cross(0.4, 0.2), "rectangular", False),
    (Rectangle(0.55), "square", True),
]


@pytest.mark.parametrize(
    ("shape", "kind", "turned"), CASES, ids=[c[0].kind for c in CASES]
)
def test_tapered_pillars_have_the_volume_of_their_shape_on_their_sites_in_every_format(
    shape, kind, turned, tmp_path
):
    made = lens(shape, kind, turned=turned)
    pillars = verbs.tile(made, TILTED)
    d = made.diameters
    row, column = np.nonzero(d.diameter_um)
    assert pillars.x_um == pytest.approx(d.x_um[column])
    assert pillars.y_um == pytest.approx(d.y_um[row])
    sizes = d.diameter_um[row, column]
    want = np.array([simpson(AREAS[shape.kind](size)) for size in sizes])
    bodies = mesh.meshes(pillars)
    # polygons of the area of a curve at both ends: the volume between them is that of
    # the curve
    assert np.array([mesh.volume_um3(b) for b in bodies])[
        pillars.kind
    ] == pytest.approx(want, rel=1e-9)
    mesh.write_stl(tmp_path / "a.stl", pillars)
    mesh.write_3mf(tmp_path / "a.3mf", pillars)
    mesh.write_gltf(tmp_path / "a.glb", pillars)
    assert readback.stl_differences(tmp_path / "a.stl", pillars) == ()
    assert readback_meshes.differences_3mf(tmp_path / "a.3mf", pillars) == ()
    assert readback_meshes.differences_gltf(tmp_path / "a.glb", pillars) == ()


@pytest.mark.parametrize("degrees", [0.0, 1.3])
@pytest.mark.parametrize(
    "shape", [Ring(0.5), Ellipse(0.6, 0.3), U], ids=lambda s: s.kind
)
def test_step_of_any_shape_has_the_volume_of_the_shape_by_the_kernel(
    shape, degrees, tmp_path
):
    build123d = pytest.importorskip("build123d")
    made = lens(shape)
    pillars = verbs.tile(made, Process(etch=Etch(sidewall_deg=degrees)))
    verbs.write_step(tmp_path / "a.step", pillars)
    assert readback.step_differences(tmp_path / "a.step", pillars) == ()
    first = (tmp_path / "a.step").read_bytes()
    verbs.write_step(tmp_path / "a.step", pillars)
    assert (tmp_path / "a.step").read_bytes() == first
    parts = {
        part.label: part for part in build123d.import_step(tmp_path / "a.step").children
    }
    for kind, name in enumerate(pillars.names):
        section = pillars.sections[kind]
        lean = 0.7 * math.tan(math.radians(degrees))
        size = {"pillar_200nm": 0.2, "pillar_260nm": 0.26}[name]
        areas = [shape.outline(size, grow_um=g).area_um2 for g in (lean, 0.0, -lean)]
        want = 0.7 / 6 * (areas[0] + 4 * areas[1] + areas[2])
        assert section.volume_um3(0.7) == pytest.approx(want, rel=1e-9)
        assert 1e9 * parts[name].volume == pytest.approx(want, rel=1e-6)


def test_a_solid_that_is_turned_thicker_or_without_its_hole_is_told(tmp_path):
    pillars = verbs.tile(lens(Rectangle(0.55), turned=True), TILTED)
    mesh.write_3mf(tmp_path / "a.3mf", pillars)
    other = tuple(
        Section(s.name, s.foot.turned(1e-3), s.top.turned(1e-3)) for s in pillars.shaped
    )
    assert any(
        "corners of its foot" in line
        for line in readback_meshes.differences_3mf(
            tmp_path / "a.3mf", dataclasses.replace(pillars, shaped=other)
        )
    )
    ring = verbs.tile(lens(Ring(0.5)), TILTED)
    mesh.write_3mf(tmp_path / "b.3mf", ring)
    full = tuple(
        dataclasses.replace(
            s,
            foot=Circle().outline(2 * s.foot.radius_um),
            top=Circle().outline(2 * s.top.radius_um),
        )
        for s in ring.shaped
    )
    told = readback_meshes.differences_3mf(
        tmp_path / "b.3mf", dataclasses.replace(ring, shaped=full)
    )
    assert any("volume" in line for line in told)


def test_pillars_of_two_sizes_have_their_width_and_length_as_made():
    rng = np.random.default_rng(8)
    size, length = rng.choice([0.12, 0.2], (5, 6)), rng.choice([0.14, 0.24], (5, 6))
    axes = np.array([0.12, 0.2]), np.array([0.14, 0.24])
    table = Pairs(
        np.array([0.94]), *axes, np.ones((1, 2, 2, 2), complex), (77.0, math.inf)
    )
    made = Lens(
        DiameterMap(size, 0.4, length_um=length),
        Cell(0.4, shape=Rectangle()),
        table.proxy,
        0.94,
        77.0,
        math.inf,
        "map",
        pairs=table,
    )
    pillars = verbs.tile(
        made, Process(bias=Bias(table_nm=((100.0, -6.0), (300.0, -6.0))))
    )
    assert len(set(pillars.names)) == 4
    for kind, (width, long) in zip(
        pillars.kind, np.stack([size.ravel(), length.ravel()], 1), strict=True
    ):
        assert np.ptp(mesh.meshes(pillars)[kind].vertices_um, axis=0) == pytest.approx(
            [width, long, 0.7], abs=1e-9
        )


@pytest.mark.parametrize(
    ("shape", "degrees", "words"),
    [
        (Ring(0.1), 2.0, "close a hole"),
        (Rectangle(0.3), 6.0, "nothing of the top"),
        (Circle(hole=True), 1.0, "openings"),
    ],
)
def test_what_walls_close_and_openings_of_a_film_are_refused(shape, degrees, words):
    with pytest.raises(ProcessError, match=words):
        verbs.tile(lens(shape), Process(etch=Etch(sidewall_deg=degrees)))


def test_the_square_that_would_do_holds_no_more_than_a_file_takes_on_a_hexagonal_lattice():
    there = np.where(np.add.outer(np.arange(150), np.arange(260)) % 2 == 0, 0.2, 0.0)
    grid = DiameterMap(there, 0.42, Lattice("hexagonal"))
    made = Lens(
        grid, Cell(0.42, lattice=grid.lattice), PROXY, 0.94, 77.0, math.inf, "map"
    )
    with pytest.raises(ProcessError, match=r"side_um = \d") as refused:
        verbs.check_count(verbs.tile(made, TILTED), "STEP")
    side = float(str(refused.value).split("side_um = ")[1].split(" ")[0])
    for centre in ((0.0, 0.0), (0.1, 0.13)):
        verbs.check_count(
            verbs.tile(made, TILTED, side_um=side, centre_um=centre), "STEP"
        )
