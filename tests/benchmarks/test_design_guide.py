"""The design guide: names of cells, lenses of known phase, ratios of hand-made lines, one tiny run that resumes."""

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import design_guide as guide
from benchmarks import design_guide_report as told
from benchmarks import keep_line, kept_lines
from codesign.evaluate.reader import ReaderConfig
from codesign.evaluate.reader_lens import LensTraining
from codesign.optics.stack import added_phase
from metalens.image.pupil import coordinates


def _line(name, axial, window=1.0):
    values = dict(axial_mm=axial, lateral_mm=axial / 2, window_mm=window, trusted_mm=window / 2, guess_mm=2.6)
    return {name: {"run": name, **values}}


def test_every_name_of_the_plan_is_that_of_its_cell():
    names = guide.plan({})
    assert len(names) == len(set(names)) > 60
    for name in names:
        cell, seed = guide.run_of(name)
        assert f"{cell.name}/{seed}" == name
    assert guide.cell_of("fwhm=30,field=ring") == guide.Cell(field="ring", fwhm=30.0)
    assert guide.cell_of("fwhm=30,field=ring").name == "field=ring,fwhm=30"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("width=3/0", "no knob 'width'"),
        ("fwhm=30,fwhm=10/0", "or twice"),
        ("fwhm=broad/0", "fwhm = 'broad' is no number"),
        ("field=corner/1", "one of axis, oblique, ring"),
        ("lens=fresnel40/1", "and a lens: focusF"),
        ("lens=free-helix2/1", "and a lens: focusF"),
        ("lens=radial-oblique40/1", "radial- of the first two"),
        ("base", "need CELL/SEED"),
        ("base/-1", "need CELL/SEED"),
    ],
)
def test_bad_names_are_refused_before_any_run(tmp_path, name, message):
    with pytest.raises(SystemExit, match=message):
        guide.run(tmp_path, [name])
    assert not list(tmp_path.iterdir())


def test_a_quadratic_lens_has_the_phase_of_a_parabola():
    """Its coefficients and the hyperbolic focus add up to -k r² (1/d + 1/s) / 2, a constant left free."""
    settings = guide.optics_of(cell := guide.cell_of("lens=quadratic40"))
    added = added_phase(settings, guide.start_of(cell))
    x, y = (c.double() for c in coordinates(settings.pupil))
    r2, k = x**2 + y**2, 2 * math.pi / 0.85
    inside = r2 <= 500.0**2
    hyperbolic = -k * sum(torch.sqrt(r2 + d**2) - d for d in (2000.0, 40000.0))
    off = (hyperbolic + added + k * r2 / 2 * (1 / 2000.0 + 1 / 40000.0))[inside]
    assert float(off.std()) < 1e-3  # six radial terms; the spherical part alone is 2 rad rms
    assert float(added[inside].std()) > 1


def test_an_interval_is_students():
    """2, 3, 7: mean 4, deviation √7, t(0.975, 2) = 4.3027."""
    found = told.interval([2.0, 3.0, 7.0])
    assert found.mean == 4
    assert found.high - 4 == pytest.approx(4.3027 * math.sqrt(7 / 3), rel=1e-4)
    assert 4 - found.low == pytest.approx(found.high - 4)
    assert str(told.interval([0.5])) == "0.50 (one seed)"


def test_ratios_are_paired_by_seed():
    """Every seed halves or doubles both: the ratio is 0.8 in each, so its interval has no width; unpaired it has."""
    base = {0: 1.0, 1: 2.0, 2: 0.5, 4: 3.0}
    mine = {seed: 0.8 * base[seed] for seed in (2, 1, 0)} | {3: 90.0}
    found = told.ratio(mine, base)
    assert (found.mean, found.low, found.high) == pytest.approx((0.8, 0.8, 0.8))
    assert found.seeds == 3
    apart = told.ratio({0: 2.0, 1: 8.0}, {0: 1.0, 1: 2.0})  # 2 and 4: geometric mean √8, t(0.975, 1) = 12.706
    assert apart.mean == pytest.approx(math.sqrt(8))
    assert math.log(apart.high / apart.mean) == pytest.approx(12.706 * math.log(2) / 2, rel=1e-4)
    with pytest.raises(ValueError, match="no seed in common"):
        told.ratio({0: 1.0}, {1: 1.0})


def _scanned():
    """Lines that choose: least of the foci is 70 mm, of the designers' lenses the oblique one of 150 mm."""
    device, lines = guide.DEVICE[0], {}
    for family in ("focus", "designer"):
        for k, cell in enumerate(guide.candidates(device, family)):
            best = "focus70" in cell or "oblique150" in cell
            lines |= _line(f"{cell}/{guide.CHOICE}", 0.9 if best else 1.2 + 0.1 * k)
    return device, lines


def test_what_is_chosen_is_least_in_the_runs_that_choose_and_then_planned():
    device, lines = _scanned()
    roles = guide.compared(lines, device)
    assert roles == {
        "focus": "lens=focus70,field=oblique,fwhm=30",
        "designer": "lens=oblique150,field=oblique,fwhm=30",
        "trained": "lens=free-focus70,field=oblique,fwhm=30",
    }
    assert {f"{cell}/4" for cell in roles.values()} <= set(guide.plan(lines))
    first = next(iter(lines))
    assert guide.chosen({k: v for k, v in lines.items() if k != first}, device, "focus") is None


def test_the_page_tells_ratios_to_best_focus_and_designer_and_what_is_missing():
    device, lines = _scanned()
    for seed in range(3):
        for role, share in (("focus", 1.0), ("designer", 0.9), ("trained", 0.72)):
            lines |= _line(f"{guide.compared(lines, device)[role]}/{seed}", share * (1 + seed), window=share)
        lines |= _line(f"base/{seed}", 0.4) | _line(f"fwhm=30/{seed}", 0.5)
    rows = {row["role"]: row for row in told.device_rows(lines)[device]}
    assert rows["trained"]["axial_mm_ratio"].mean == pytest.approx(0.72)
    assert rows["trained"]["to_designer"].mean == pytest.approx(0.8)
    assert rows["focus"]["axial_mm"].mean == pytest.approx(2.0)  # without the run that chose
    page = told.page(lines)
    assert "Trained to the best designer's lens, axial: 0.80 [0.80, 0.80]." in page
    assert "| `fwhm=30` | 3 | 0.50 [0.50, 0.50] | 1.25 [1.25, 1.25] |" in page
    assert "`electrons=500`" in page.split("Planned and not measured")[1]
    assert "`fwhm=30`" not in page.split("Planned and not measured")[1]
    assert "3 to 29° along x" in page  # atan(tan 17° ± 504 / 2000)
    assert "±25° about the axis" in page


def test_a_run_trains_its_lens_once_and_goes_on_where_it_was(tmp_path, monkeypatch):
    tiny = ReaderConfig(frames=64, pool=32, test=32, pixels=32, pitch_um=36.0)
    monkeypatch.setattr(guide.Cell, "reader", property(lambda cell: tiny))
    monkeypatch.setattr(
        guide, "TRAINING", LensTraining(turns=1, hold=1, batch=4, phase=replace(guide.TRAINING.phase, start=0))
    )
    monkeypatch.setattr(guide, "IMAGE", 0.4)
    monkeypatch.setattr(guide, "TRAINED", 0.4)
    names = ["lens=radial-focus40,pitch=36/0", "lens=radial-focus40,pitch=36/1"]
    guide.run(tmp_path, names)
    first = (tmp_path / guide.LINES).read_bytes()
    assert [line["run"] for line in kept_lines(tmp_path / guide.LINES)] == names
    (design,) = kept_lines(tmp_path / guide.DESIGNS)
    assert len(design["coefficients_rad"]) == guide.RADIAL
    assert any(design["coefficients_rad"])
    guide.run(tmp_path, names)
    assert (tmp_path / guide.LINES).read_bytes() == first
    other = tmp_path / "other"
    other.mkdir()
    keep_line(other / guide.DESIGNS, design)
    guide.run(other, names[1:])
    again, kept = kept_lines(other / guide.LINES)[0], kept_lines(tmp_path / guide.LINES)[1]
    assert {k: v for k, v in again.items() if k != "cpu_s"} == {k: v for k, v in kept.items() if k != "cpu_s"}
