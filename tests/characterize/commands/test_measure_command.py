"""``metalens measure``: numbers of drawn spots and drawn pillars, in files that other
tools read.
"""

import csv
import json
import math

import numpy as np
import pytest
import tifffile
from scipy import special

from metalens import lens as lenses
from metalens.cell import Cell, Index
from metalens.cell.shapes import Circle, Square
from metalens.lens import DiameterMap, Lens
from tests.characterize.measure import test_sem
from tests.command_line import call
from tests.proxies import proxy_of


def spots(folder, sigma_um, pixel_um=0.9, depth_um=None):
    """Gaussian spots on a background, one a depth; D4 sigma is 4 sigma, FWHM 2.355
    sigma, MTF50 0.1874 / sigma.
    """
    folder.mkdir()
    rng = np.random.default_rng(2)
    axis = (np.arange(41) - 20) * pixel_um
    lines = ["file,depth_um"]
    for i, sigma in enumerate(sigma_um):
        light = 9000 * np.exp(
            -((axis[None] - 0.7) ** 2 + (axis[:, None] + 0.4) ** 2) / 2 / sigma**2
        )
        counts = np.rint(light + 120 + 2 * rng.standard_normal(light.shape)).astype(
            np.uint16
        )
        tifffile.imwrite(folder / f"f{i}.tif", counts)
        lines.append(f"f{i}.tif,{depth_um[i] if depth_um else 500 + 100 * i}")
    (folder / "stage.csv").write_text("\n".join(lines) + "\n")
    (folder / "capture.toml").write_text(
        f"pixel_um = {pixel_um}\nwavelength_um = 0.85\nbits = 16\n"
    )


def save_design(path, drawn_nm, shape=Circle()):  # noqa: B008
    """A lens file of pillars of the drawn diameters."""
    cell = Cell(pitch_um=test_sem.PITCH * 1e-3, pillar=Index(3.6), shape=shape)
    proxy = proxy_of([1.0, 2.0], [0.9], (0.1, 0.35), 0.85)
    drawn = DiameterMap(drawn_nm * 1e-3, cell.pitch_um, cell.lattice)
    lenses.save(path, Lens(drawn, cell, proxy, 0.85, 100.0, 1e3, "map"))


def save_picture(path, image):
    counts = np.clip((image + 0.5) * 2e4, 0, 65535).astype(np.uint16)
    tifffile.imwrite(path, counts)


def test_captures_give_spot_sizes_and_the_sharpest_depth(tmp_path):
    sigmas = (4.1, 3.2, 2.7, 3.0, 3.9)
    spots(tmp_path / "shots", sigmas)
    assert call(f"measure {tmp_path}/shots -o {tmp_path}/out --quiet") == 0
    with open(tmp_path / "out" / "frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for row, sigma in zip(rows, sigmas, strict=True):
        # drawn at the pixels' middles
        assert float(row["fwhm_um"]) == pytest.approx(2.3548 * sigma, rel=0.02)
        assert float(row["mtf50_x_per_um"]) == pytest.approx(0.18739 / sigma, rel=0.02)
        assert float(row["centroid_x_um"]) == pytest.approx(0.7, abs=0.1)
        assert float(row["centroid_y_um"]) == pytest.approx(-0.4, abs=0.1)
        # no reference: not known
        assert float(row["efficiency"]) != float(row["efficiency"])
    told = json.loads((tmp_path / "out" / "measure.json").read_text())
    (best,) = told["best_depth"]
    assert 690 < best["depth_um"] < 760
    assert (best["angle_deg"], best["angle_y_deg"]) == (0.0, 0.0)
    assert (tmp_path / "out" / "measure.html").is_file()


@pytest.mark.parametrize(
    ("sigmas", "end"),
    [((2.7, 3.0, 3.9, 4.1), 500), ((4.1, 3.4, 3.0), 700), ((3.9, 3.0, 3.6), None)],
)
def test_a_sharpest_depth_that_is_the_first_or_last_is_told(
    tmp_path, capsys, sigmas, end
):
    spots(tmp_path / "shots", sigmas)
    assert call(f"measure {tmp_path}/shots -o {tmp_path}/out") == 0
    said = capsys.readouterr().out
    words = f"note: sharpest at 0, 0 deg at an end of the captured depths, {end} um: focus may lie beyond it"
    assert (words in said) == (end is not None)
    assert ("focus may lie beyond" in said) == (end is not None)


def test_the_sharpest_place_of_a_stage_about_zero_with_a_repeated_frame(tmp_path):
    """Widths 2.5 sqrt(1 + ((z - 20) / 150)²): a parabola of 1 / (1 + u²) through
    -100, 0 and 100 has its top at 14.6; noise adds some um.
    """
    z = (-200, -100, 0, 100, 200, -100)
    sigmas = [2.5 * math.hypot(1, (place - 20) / 150) for place in z]
    spots(tmp_path / "shots", sigmas, depth_um=z)
    assert call(f"measure {tmp_path}/shots -o {tmp_path}/out --quiet") == 0
    told = json.loads((tmp_path / "out" / "measure.json").read_text())
    assert told["best_depth"][0]["depth_um"] == pytest.approx(20, abs=10)


def test_light_beside_that_of_an_empty_aperture_is_the_efficiency(tmp_path):
    """A circle of three widths at half height holds 1 - exp(-(3 x 2.3548 / 2)² / 2) =
    0.998 of a Gaussian's light.
    """
    spots(tmp_path / "shots", (3.0, 2.5, 2.8))
    light = 9000 * 2 * math.pi * (2.5 / 0.9) ** 2
    words = f"--reference-e {1.25 * light} -o {tmp_path}/out --quiet"
    assert call(f"measure {tmp_path}/shots {words}") == 0
    row = json.loads((tmp_path / "out" / "measure.json").read_text())["frames"][1]
    # pixels cut by the circle, the border's median
    assert row["efficiency"] == pytest.approx(0.998 / 1.25, rel=0.02)


def test_an_edge_gives_the_modulation_across_it(tmp_path):
    """An edge blurred by a Gaussian of 1.7 pixels and by the pixels: MTF sinc(f) exp(-2
    (pi f 1.7)²), f a pixel.
    """
    y, x = np.mgrid[:90, :80]
    across = (x - 38.3 + 0.12 * (y - 44)) / math.hypot(1, 0.12)
    light = 200 + 3000 * special.ndtr(across / math.hypot(1.7, 1 / math.sqrt(12)))
    tifffile.imwrite(tmp_path / "edge.tif", np.rint(light).astype(np.uint16))
    out = tmp_path / "out"
    assert call(f"measure {tmp_path}/edge.tif --edge-um 2.4 -o {out} --quiet") == 0
    rows = np.loadtxt(out / "edge.csv", delimiter=",", skiprows=1)
    f = rows[:, 0] * 2.4
    want = np.sinc(f) * np.exp(-2 * (math.pi * f * 1.7) ** 2)
    low = f < 0.2
    # of the metric; the box of a pixel is nearly a Gaussian
    assert abs(rows[low, 1] - want[low]).max() < 0.02
    half = float(np.interp(-0.5, -want[f < 0.4], f[f < 0.4])) / 2.4
    assert json.loads((out / "measure.json").read_text())[
        "mtf50_per_um"
    ] == pytest.approx(half, rel=0.02)
    assert (out / "measure.html").is_file()
    both = f"measure {tmp_path}/edge.tif --edge-um 2.4 --pixel-nm 4 -o {out} --quiet"
    assert call(both) == 2


def test_a_micrograph_gives_every_pillar(tmp_path):
    truth = np.random.default_rng(1).uniform(160, 280, (4, 4))
    image = test_sem.render(truth, missing={(1, 2)})
    save_picture(tmp_path / "sem.tif", image)
    arguments = f"measure {tmp_path}/sem.tif -o {tmp_path}/out --pixel-nm 4.0 --quiet"
    assert call(arguments) == 0
    with open(tmp_path / "out" / "pillars.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows].count("missing") == 1
    error = [
        float(r["diameter_nm"]) - t
        for r, t in zip(rows, truth.ravel(), strict=True)
        if r["state"] == "good"
    ]
    assert len(error) == 15
    assert np.abs(np.mean(error)) < 1.2
    assert call(arguments) == 2  # exists


@pytest.mark.parametrize("repeats", [False, True])
def test_no_bias_table_where_two_places_of_the_mask_fit_alike(tmp_path, repeats):
    """A mask of unlike pillars holds the picture once; where all its rows and columns
    come again, it may lie twice.
    """
    drawn = np.random.default_rng(4).uniform(160, 280, (4, 4))
    mask = (
        np.tile(drawn, (2, 2))
        if repeats
        else np.pad(drawn, 2, mode="wrap")[:7, :7] + np.arange(7) ** 2
    )
    save_design(tmp_path / "lens.h5", mask)
    image = test_sem.render(drawn if repeats else mask[2:6, 2:6])
    save_picture(tmp_path / "sem.tif", image)
    arguments = f"measure {tmp_path}/sem.tif --pixel-nm 4.0 --design {tmp_path}/lens.h5"
    assert call(f"{arguments} -o {tmp_path}/out --quiet") == 0
    told = json.loads((tmp_path / "out" / "measure.json").read_text())
    assert told["place_is_clear"] != repeats
    assert bool(told["bias_nm"]) != repeats
    assert (tmp_path / "out" / "bias.toml").is_file() != repeats


def test_no_bias_table_on_a_pixel_that_the_mask_shows_to_be_wrong(tmp_path, capsys):
    """A pixel stated 1.7 % too large makes pillars of 220 nm 3.7 nm too wide; the
    mask's lattice tells by how much.
    """
    mask = np.random.default_rng(4).uniform(160, 280, (7, 7))
    save_design(tmp_path / "lens.h5", mask)
    save_picture(tmp_path / "sem.tif", test_sem.render(mask[1:6, 2:7]))
    arguments = f"measure {tmp_path}/sem.tif --design {tmp_path}/lens.h5 --pixel-nm"
    assert call(f"{arguments} 4.068 -o {tmp_path}/out") == 0
    told = json.loads((tmp_path / "out" / "measure.json").read_text())
    assert told["place_is_clear"]
    # 0.1 pixels at either end of 4 x 100
    assert told["pitch_over_design"] == pytest.approx(1.017, abs=5e-4)
    assert told["bias_nm"] == []
    assert not (tmp_path / "out" / "bias.toml").exists()
    better = capsys.readouterr().out.split("--pixel-nm ")[1].split()[0]
    assert call(arguments, better, f"-o {tmp_path}/again") == 0
    assert "what the microscope adds" in capsys.readouterr().out
    assert call(arguments, better, f"--edge-bias-nm 0.3 -o {tmp_path}/told") == 0
    assert "what the microscope adds" not in capsys.readouterr().out
    told = json.loads((tmp_path / "again" / "measure.json").read_text())
    assert max(abs(bias) for _, bias, *_ in told["bias_nm"]) < 1.5
    assert (tmp_path / "again" / "bias.toml").is_file()


@pytest.mark.parametrize("shape", [Square(), Circle(hole=True)])
def test_pillars_whose_diameter_is_not_what_is_drawn_are_refused(
    tmp_path, capsys, shape
):
    """A circle through the sides of a square is 1.12 times as wide as its side: a bias
    of 25 nm that is none.
    """
    save_design(tmp_path / "lens.h5", np.full((7, 7), 220.0), shape)
    save_picture(tmp_path / "sem.tif", test_sem.render(np.full((4, 4), 220.0)))
    arguments = f"measure {tmp_path}/sem.tif --pixel-nm 4.0 --design {tmp_path}/lens.h5"
    assert call(f"{arguments} -o {tmp_path}/out --quiet") == 2
    assert "--design takes round pillars" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_lattice_on_which_most_pillars_are_no_discs_ends_1_and_says_so(
    tmp_path, capsys
):
    """Bars of 60 x 28 pixels at 100: their edges lie 14 to 33 pixels from the middle,
    on no circle.
    """
    y, x = np.indices((400, 400)) % 100 - 49.5
    bar = (np.abs(x) < 30) & (np.abs(y) < 14)
    picture = 40 + 120 * bar + 3 * np.random.default_rng(3).standard_normal(bar.shape)
    tifffile.imwrite(tmp_path / "a.tif", picture.astype(np.uint8))
    assert call(f"measure {tmp_path}/a.tif --pixel-nm 4 -o {tmp_path}/out") == 1
    told = capsys.readouterr().out
    assert "  FAILED: most sites hold no round pillar: is the lattice of" in told
    assert "--pitch-nm states it" in told
    assert (tmp_path / "out" / "pillars.csv").is_file()


def test_writing_below_a_micrograph_changes_no_pillar(tmp_path, capsys):
    """A strip of 120 rows, high enough for a row of sites, with a bar of 125 pixels:
    500 nm, of pixels of 4 nm.
    """
    picture = test_sem.render(np.random.default_rng(8).uniform(150, 250, (4, 4)))
    grey = np.clip(60 + 120 * picture, 0, 254).astype(np.uint8)
    strip = np.zeros((120, grey.shape[1]), np.uint8)
    strip[50:56, 20:145] = 255
    for name, image in (("bare", grey), ("written", np.concatenate([grey, strip]))):
        tifffile.imwrite(tmp_path / f"{name}.tif", image)
        scale = ["--pixel-nm", "4"] if name == "bare" else ["--bar-nm", "500"]
        assert (
            call(f"measure {tmp_path}/{name}.tif", *scale, f"-o {tmp_path}/{name}") == 0
        )
        assert ("120 rows of writing below" in capsys.readouterr().out) == (
            name == "written"
        )
    bare, written = (
        (tmp_path / name / "pillars.csv").read_text() for name in ("bare", "written")
    )
    assert bare == written
