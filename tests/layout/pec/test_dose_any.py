"""``metalens dose``: doses of any polygons beside closed forms and plain sums."""

import csv
import json

import numpy as np
import pytest
from scipy.special import erf

import layout
from layout.formats import gdsii_write
from layout.formats.library import MaskCell, MaskLibrary
from layout.process.process import ExposureSettings
from layout.shapes import polygon
from metalens.core.errors import ProcessError
from tests.command_line import call

ALPHA_UM, BETA_UM, ETA = 0.017, 5.3, 0.7
EXPOSURE = ExposureSettings(alpha_um=ALPHA_UM, beta_um=BETA_UM, eta=ETA)


def box(x, y, width, height):
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])


def library(*shapes, layer=(1, 0)):
    return MaskLibrary("TOP", {"TOP": MaskCell("TOP", {layer: list(shapes)})})


def test_a_wide_pad_has_the_doses_of_a_half_plane():
    """The dose at the edge of a half plane solves a Wiener-Hopf equation with a
    Gaussian kernel: (1 + eta) / sqrt(1 + 2 eta) at the edge, (1 + eta) / (1 + 2 eta) far
    inside, each edge at half of what a wide area receives.

    Budget: 0.75 % of the ladder, 0.25 % of pieces of an eighth of the range.
    """
    dosed = layout.correct(library(box(300, -700, 71_000, 53_000)), EXPOSURE)
    pieces = [
        (piece, dosed.doses[key])
        for key, listed in dosed.cells["TOP"].polygons.items()
        for piece in listed
    ]
    for at, wanted in (
        ((30_000, 22_000), (1 + ETA) / (1 + 2 * ETA)),
        ((301, 20_000), (1 + ETA) / np.sqrt(1 + 2 * ETA)),
        ((35_000, 52_299), (1 + ETA) / np.sqrt(1 + 2 * ETA)),
    ):
        (dose,) = [
            dose
            for piece, dose in pieces
            if (piece.min(0) <= at).all() and (at < piece.max(0)).all()
        ]
        assert dose == pytest.approx(wanted, rel=0.01)


@pytest.mark.parametrize("words", [(), ("--thousandths",)])
def test_a_file_of_any_polygons_is_written_with_its_doses(tmp_path, capsys, words):
    """KLayout finds the same area; straight edges are at dose to size by a sum of error
    functions over the boxes and of discs as points, each with the dose of its datatype.

    Budget: tolerance 1 % (twice that near a corner), 0.05 % of rounded doses.
    """
    db = pytest.importorskip("klayout.db")
    discs = [
        polygon.disc_polygon(90, (17_000 + 400 * i, 3000 + 400 * j), 24)
        for i in range(8)
        for j in range(11)
    ]
    ell = np.array([[0, 0], [9, 0], [9, 4], [5, 4], [5, 13], [0, 13]]) * 1000
    pads = [ell, box(12_000, 3000, 1500, 17_000)]
    gdsii_write.write_gdsii(library(*pads, *discs, layer=(4, 2)), tmp_path / "a.gds")
    (tmp_path / "p.toml").write_text(
        f"[exposure]\nalpha_um = {ALPHA_UM}\nbeta_um = {BETA_UM}\neta = {ETA}\n"
    )
    out = tmp_path / "out"
    about = f"--process {tmp_path}/p.toml -o {out} --json"
    assert call(f"dose {tmp_path}/a.gds {about}", *words) == 0
    assert json.loads(capsys.readouterr().out)["ok"]
    regions = []
    for path in (tmp_path / "a.gds", out / "mask.gds"):
        there = db.Layout()
        there.read(str(path))
        regions.append(db.Region())
        for info in there.layer_infos():
            shapes = there.top_cell().begin_shapes_rec(there.layer(info))
            regions[-1].insert(db.Region(shapes))
    assert (regions[0] ^ regions[1]).is_empty()
    with (out / "doses.csv").open() as file:
        doses = {
            int(row["datatype"]): float(row["relative_dose"])
            for row in csv.DictReader(file)
        }
    if words:
        assert all(number == round(1000 * dose) for number, dose in doses.items())
    boxes, points = [], []
    for datatype, dose in doses.items():
        shapes = there.top_cell().begin_shapes_rec(there.layer(4, datatype))
        for shape in db.Region(shapes).each():
            b = shape.bbox()
            if shape.is_box():
                boxes.append((b.left, b.bottom, b.right, b.top, dose * 1000))
            else:
                points.append((b.center().x, b.center().y, shape.area(), dose * 1000))
    left, bottom, right, top, dose = np.array(boxes).T[:, :, None] / 1e3
    px, py, area, point_dose = np.array(points).T[:, :, None] / 1e3
    ends = np.array([[5.0, 8.1], [5.0, 10.3], [12.0, 9.3], [13.5, 18.7], [2.2, 13.0]])
    exposure = 0.0
    x, y = ends.T
    for width, weight in ((ALPHA_UM, 1 / (1 + ETA)), (BETA_UM, ETA / (1 + ETA))):
        across = erf((right - x) / width) - erf((left - x) / width)
        along = erf((top - y) / width) - erf((bottom - y) / width)
        far = np.exp(-((x - px) ** 2 + (y - py) ** 2) / width**2)
        exposure += weight * (dose * across * along).sum(0) / 4
        scale = point_dose * area / 1e3 / (np.pi * width**2)
        exposure += weight * (scale * far).sum(0)
    assert abs(exposure / 0.5 - 1).max() < 0.0105


def test_layers_that_are_not_one_exposure_are_refused(tmp_path):
    both = {(1, 0): [box(0, 0, 5000, 5000)], (2, 0): [box(0, 0, 900, 900)]}
    mask = MaskLibrary("TOP", {"TOP": MaskCell("TOP", both)})
    with pytest.raises(ProcessError, match=r"layers \[1, 2\]"):
        layout.correct(mask, EXPOSURE)
    dosed = layout.correct(mask, EXPOSURE, layer=2)
    assert {number for number, _ in dosed.layers} == {2}
