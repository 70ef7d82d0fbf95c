"""Solids of pillars of any shape, rotation and lattice: volumes in closed form, places
of the sites, STL by its own layout and STEP by the CAD kernel.
"""

import math
import struct

import numpy as np
import pytest

from layout import solids
from layout.process.process import EtchProfile, Process
from metalens.cell import Cell, Lattice
from metalens.cell.shapes import Circle, Cross, Ellipse, Polygon, Rectangle, Ring
from metalens.core.errors import ProcessError
from metalens.fabrication import Bias
from metalens.lens import DiameterMap, Lens, TwoSizeTable
from metalens.library import Proxy

PROXY = Proxy(
    np.array([[3.0, 3.0]]), np.array([[0.93]]), (0.05, 0.32), (0.94, 0.94), 0.01, 0.01
)
HEIGHT = Cell(0.42).height_um
DEGREES = 1.3
TILTED = Process(etch=EtchProfile(sidewall_deg=DEGREES))
# um by which both edges together move from half height to the foot
LEAN = HEIGHT * math.tan(math.radians(DEGREES))
U = Polygon(
    ((-0.5, -0.45), (0.5, -0.35), (0.5, 0.5), (0.2, 0.5), (0.2, 0.0), (-0.2, -0.1),
     (-0.25, 0.4), (-0.5, 0.4)), 0.2,
)  # fmt: skip


def lens(shape, kind="square", *, turned=False):
    rng = np.random.default_rng(7)
    lattice = Lattice(kind, 1.15 if kind == "rectangular" else 1.0)
    size = rng.choice([0.0, 0.2, 0.26], (6, 9))
    if lattice.centred:
        size[np.add.outer(np.arange(6), np.arange(9)) % 2 == 1] = 0
    angle = np.radians(rng.integers(0, 40, size.shape)) if turned else None
    grid = DiameterMap(size, 0.42, lattice, angle_rad=angle)
    cell = Cell(0.42, shape=shape, lattice=lattice)
    hand = "left" if turned else ""
    return Lens(grid, cell, PROXY, 0.94, 77.0, math.inf, "map", hand=hand)


def volume(area, lean=LEAN):
    """Of a pillar ``lean`` wider at the foot and narrower at the top: Simpson's rule,
    exact for areas that are quadratic in the height.
    """
    return HEIGHT / 6 * (area(lean) + 4 * area(0.0) + area(-lean))


AREAS = {  # of a size d, grown by g on both sides together
    "circle": lambda d: lambda g: math.pi / 4 * (d + g) ** 2,
    "ring": lambda d: lambda g: math.pi / 4 * ((d + g) ** 2 - (0.5 * d - g) ** 2),
    "ellipse": lambda d: lambda g: math.pi / 4 * (d + g) * (0.6 * d + g),
    "cross": lambda d: lambda g: 2 * (d + g) * (0.4 * d + g) - (0.4 * d + g) ** 2,
    "rectangle": lambda d: lambda g: (d + g) * (0.55 * d + g),
}
CASES = [
    (Circle(), "square", False),
    (Ring(0.5), "hexagonal", False),
    (Ellipse(0.6, 0.3), "square", False),
    (Cross(0.4, 0.2), "rectangular", False),
    (Rectangle(0.55), "square", True),
]


def read_stl(path):
    """Corners (triangles, 3, 3) and stored normals of a binary STL file."""
    data = path.read_bytes()
    (count,) = struct.unpack("<I", data[80:84])
    assert len(data) == 84 + 50 * count
    numbers = np.frombuffer(data[84:], np.uint8).reshape(count, 50)[:, :48].copy()
    numbers = numbers.view("<f4").reshape(count, 4, 3).astype(float)
    return numbers[:, 1:], numbers[:, 0]


@pytest.mark.parametrize(
    ("shape", "kind", "turned"), CASES, ids=[c[0].kind for c in CASES]
)
def test_stl_holds_closed_pillars_of_their_volume_on_their_sites(
    tmp_path, shape, kind, turned
):
    made = lens(shape, kind, turned=turned)
    tile = solids.cut_tile(made, TILTED)
    total = solids.write_stl(tmp_path / "a.stl", tile)
    corners, stored = read_stl(tmp_path / "a.stl")
    assert len(corners) == total
    grid = made.diameters
    row, column = np.nonzero(grid.diameter_um)
    each = corners.reshape(len(row), -1, 3, 3)
    a, b, c = (each[:, :, k] for k in range(3))
    sizes = grid.diameter_um[row, column]
    want = np.array([volume(AREAS[shape.kind](size)) for size in sizes])
    # polygons have the area of the curve at every height; single precision of places,
    # and 3 nm^2 of rounded corners of discs
    found = (a * np.cross(b, c)).sum((1, 2)) / 6
    assert found == pytest.approx(want, rel=2e-4)
    middle = (each.max((1, 2)) + each.min((1, 2))) / 2
    assert middle[:, 0] == pytest.approx(grid.x_um[column], abs=2e-3)
    assert middle[:, 1] == pytest.approx(grid.y_um[row], abs=2e-3)
    assert middle[:, 2] == pytest.approx(HEIGHT / 2)
    for pillar in each:  # every edge runs once forth and once back
        edges = [tuple(map(tuple, t[[k, k - 2]])) for t in pillar for k in range(3)]
        assert len(set(edges)) == len(edges)
        assert {(q, p) for p, q in edges} == set(edges)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal * stored).sum(1) == pytest.approx(
        np.linalg.norm(normal, axis=1), rel=1e-3, abs=1e-8
    )


@pytest.mark.parametrize("degrees", [0.0, DEGREES])
@pytest.mark.parametrize("shape", [Circle(), Ring(0.5), Ellipse(0.6, 0.3), U])
def test_step_has_the_volume_of_each_class_by_the_kernel(tmp_path, shape, degrees):
    build123d = pytest.importorskip("build123d")
    tile = solids.cut_tile(lens(shape), Process(etch=EtchProfile(sidewall_deg=degrees)))
    solids.write_step(tmp_path / "a.step", tile)
    found = build123d.import_step(tmp_path / "a.step")
    assert len(found.children) == len(tile.kind) + 1
    parts = {part.label: part for part in found.children}
    lean = HEIGHT * math.tan(math.radians(degrees))
    for name, size in (("pillar_200nm", 0.2), ("pillar_260nm", 0.26)):

        def area(grow, size=size):
            return shape.outline(size, grow_um=grow).area_um2

        # in mm^3; 4e-5 of corner rounding of discs
        assert 1e9 * parts[name].volume == pytest.approx(volume(area, lean), rel=1e-4)


def test_step_places_shared_solids_with_labels_and_colours(tmp_path):
    build123d = pytest.importorskip("build123d")
    tile = solids.cut_tile(lens(Circle()), TILTED)
    solids.write_step(tmp_path / "a.step", tile)
    data = (tmp_path / "a.step").read_bytes()
    assert data.count(b"CONICAL_SURFACE") == 2  # one of each class
    found = build123d.import_step(tmp_path / "a.step")
    slab = found.children[0].bounding_box()
    half = 0.21
    low = tile.x_um.min() - half, tile.y_um.min() - half, -1.0
    high = tile.x_um.max() + half, tile.y_um.max() + half, 0.0
    corners = [*slab.min, *slab.max]
    assert corners == pytest.approx([1e-3 * v for v in (*low, *high)], abs=1e-9)
    order = np.argsort(tile.kind, kind="stable")
    for part, n in zip(found.children[1:], order.tolist(), strict=True):
        box = part.bounding_box()
        assert part.label == tile.sections[tile.kind[n]].name
        middle = box.center().X, box.center().Y
        assert middle == pytest.approx(
            (1e-3 * tile.x_um[n], 1e-3 * tile.y_um[n]), abs=1e-9
        )
        assert tuple(part.color)[:3] == pytest.approx((0.25, 0.35, 0.75), abs=0.01)


def test_a_square_of_the_lens_holds_its_pillars(tmp_path):
    made = lens(Circle())
    tile = solids.cut_tile(made, TILTED, side_um=1.6, centre_um=(0.4, 0.7))
    grid = made.diameters
    inside = abs(grid.x_um - 0.4) <= 0.8 + 1e-6
    inside = inside & (abs(grid.y_um[:, None] - 0.7) <= 0.8 + 1e-6)
    row, column = np.nonzero(inside & (grid.diameter_um > 0))
    assert tile.x_um == pytest.approx(grid.x_um[column])
    assert tile.y_um == pytest.approx(grid.y_um[row])
    with pytest.raises(ProcessError, match="no pillar"):
        solids.cut_tile(made, TILTED, side_um=0.1, centre_um=(90.0, 0.0))


def test_pillars_of_two_sizes_have_width_and_length_as_fabricated():
    rng = np.random.default_rng(8)
    size = rng.choice([0.12, 0.2], (5, 6))
    length = rng.choice([0.14, 0.24], (5, 6))
    axes = np.array([0.12, 0.2]), np.array([0.14, 0.24])
    table = TwoSizeTable(
        np.array([0.94]), *axes, np.ones((1, 2, 2, 2), complex), (77.0, math.inf)
    )
    grid = DiameterMap(size, 0.4, length_um=length)
    cell = Cell(0.4, shape=Rectangle())
    made = Lens(grid, cell, table.proxy, 0.94, 77.0, math.inf, "map", pairs=table)
    biased = Process(bias=Bias(table_nm=((100.0, -6.0), (300.0, -6.0))))
    tile = solids.cut_tile(made, biased)
    assert len({section.name for section in tile.sections}) == 4
    meshes = [solids.mesh_section(s, HEIGHT) for s in tile.sections]
    sizes = np.stack([size.ravel(), length.ravel(), np.full(30, HEIGHT)], 1)
    for kind, want in zip(tile.kind.tolist(), sizes, strict=True):
        found = np.ptp(meshes[kind].vertices_um, axis=0)
        assert found == pytest.approx(want, abs=1e-9)


@pytest.mark.parametrize(
    ("shape", "degrees", "words"),
    [
        (Circle(), 17.0, "nothing of the top"),
        (Ring(0.1), 2.0, "close a hole"),
        (Rectangle(0.3), 6.0, "nothing of the top"),
        (Circle(hole=True), 1.0, "openings"),
    ],
)
def test_walls_that_close_and_openings_of_a_film_are_refused(shape, degrees, words):
    with pytest.raises(ProcessError, match=words):
        solids.cut_tile(lens(shape), Process(etch=EtchProfile(sidewall_deg=degrees)))


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_too_many_pillars_are_refused_with_a_square_that_would_do(tmp_path, kind):
    size = np.full((150, 260), 0.2)
    if kind == "hexagonal":
        size[np.add.outer(np.arange(150), np.arange(260)) % 2 == 1] = 0
    grid = DiameterMap(size, 0.42, Lattice(kind))
    cell = Cell(0.42, lattice=grid.lattice)
    made = Lens(grid, cell, PROXY, 0.94, 77.0, math.inf, "map")
    (tmp_path / "a.step").write_text("old")
    with pytest.raises(ProcessError, match=r"too many for STEP.*side_um = \d") as told:
        solids.write_step(tmp_path / "a.step", solids.cut_tile(made, TILTED))
    assert (tmp_path / "a.step").read_text() == "old"
    side = float(str(told.value).split("side_um = ")[1].split(" ")[0])
    for centre in ((0.0, 0.0), (0.1, 0.13)):
        part = solids.cut_tile(made, TILTED, side_um=side, centre_um=centre)
        solids.check_count(part, "STEP")
