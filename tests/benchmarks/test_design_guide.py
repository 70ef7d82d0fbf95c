"""The design guide: names of cells, lenses of known phase, ratios of hand-made lines,
one tiny run that resumes.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks import design_guide as guide
from benchmarks import design_guide_bound as bound
from benchmarks import design_guide_network as network
from benchmarks import design_guide_report as told
from benchmarks import keep_line, kept_lines
from benchmarks.design_guide_cells import FIELDS, Cell, cell_of, corner_rad, run_of
from benchmarks.design_guide_image import forms
from benchmarks.design_guide_stop import asphere
from codesign.evaluate.reader import ReaderConfig
from codesign.evaluate.reader_lens import LensTraining
from codesign.optics.stack import added_phase, phase_at
from metalens.field import SmoothWave
from metalens.image.pupil import coordinates


def _line(name, axial, window=1.0):
    values = dict(
        axial_mm=axial,
        lateral_mm=axial / 2,
        window_mm=window,
        trusted_mm=window / 2,
        guess_mm=2.6,
    )
    return {name: {"run": name, **values}}


def test_every_name_of_the_plan_is_that_of_its_cell():
    names = guide.plan({})
    assert len(names) == len(set(names)) > 60
    for name in names:
        cell, seed = run_of(name)
        assert f"{cell.name}/{seed}" == name
    assert cell_of("fwhm=30,field=ring") == Cell(field="ring", fwhm=30.0)
    assert cell_of("fwhm=30,field=ring").name == "field=ring,fwhm=30"


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
        ("lens=free-stop40/1", "and of stopF"),
        ("reader=oracle/1", "one of reference, network"),
        ("field=line,reader=network/0", "a field that is not held"),
        ("base", "need CELL/SEED"),
        ("base/-1", "need CELL/SEED"),
    ],
)
def test_bad_names_are_refused_before_any_run(tmp_path, name, message):
    with pytest.raises(SystemExit, match=message):
        guide.run(tmp_path, [name])
    assert not list(tmp_path.iterdir())


def test_a_quadratic_lens_has_the_phase_of_a_parabola():
    """Its coefficients and the hyperbolic focus add up to -k r² (1/d + 1/s) / 2, a
    constant left free.
    """
    settings = guide.optics_of(cell := cell_of("lens=quadratic40"))
    added = added_phase(settings, guide.start_of(cell))
    x, y = (c.double() for c in coordinates(settings.pupil))
    r2, k = x**2 + y**2, 2 * math.pi / 0.85
    inside = r2 <= 500.0**2
    hyperbolic = -k * sum(torch.sqrt(r2 + d**2) - d for d in (2000.0, 40000.0))
    off = (hyperbolic + added + k * r2 / 2 * (1 / 2000.0 + 1 / 40000.0))[inside]
    assert (
        float(off.std()) < 1e-3
    )  # six radial terms; the spherical part alone is 2 rad rms
    assert float(added[inside].std()) > 1


def test_an_interval_is_students():
    """2, 3, 7: mean 4, deviation √7, t(0.975, 2) = 4.3027."""
    found = told.interval([2.0, 3.0, 7.0])
    assert found.mean == 4
    assert found.high - 4 == pytest.approx(4.3027 * math.sqrt(7 / 3), rel=1e-4)
    assert 4 - found.low == pytest.approx(found.high - 4)
    assert str(told.interval([0.5])) == "0.50 (one seed)"


def test_ratios_are_paired_by_seed():
    """Every seed halves or doubles both: the ratio is 0.8 in each, so its interval has
    no width; unpaired it has.
    """
    base = {0: 1.0, 1: 2.0, 2: 0.5, 4: 3.0}
    mine = {seed: 0.8 * base[seed] for seed in (2, 1, 0)} | {3: 90.0}
    found = told.ratio(mine, base)
    assert (found.mean, found.low, found.high) == pytest.approx((0.8, 0.8, 0.8))
    assert found.seeds == 3
    apart = told.ratio(
        {0: 2.0, 1: 8.0}, {0: 1.0, 1: 2.0}
    )  # 2 and 4: geometric mean √8, t(0.975, 1) = 12.706
    assert apart.mean == pytest.approx(math.sqrt(8))
    assert math.log(apart.high / apart.mean) == pytest.approx(
        12.706 * math.log(2) / 2, rel=1e-4
    )
    with pytest.raises(ValueError, match="no seed in common"):
        told.ratio({0: 1.0}, {1: 1.0})


def _scanned(device=None):
    """Lines that choose: least of the foci is 70 mm, of the designers' lenses the
    oblique one of 150 mm.
    """
    device, lines = device or guide.DEVICE[0], {}
    for family in ("focus", "designer"):
        for k, cell in enumerate(guide.candidates(device, family)):
            best = "focus70" in cell or "oblique150" in cell
            lines |= _line(f"{cell}/{guide.CHOICE}", 0.9 if best else 1.2 + 0.1 * k)
    return device, lines


def test_asphere_for_a_stop_is_the_hyperbolic_lens_on_axis_and_of_least_variance_over_a_field():
    settings = guide.optics_of(cell := cell_of("lens=stop40,field=oblique"))
    assert (
        float(asphere(settings, 1e-7).abs().max()) < 2e-3
    )  # rad; what six terms leave is none
    best = guide.start_of(cell)
    widest = corner_rad(FIELDS["oblique"])
    assert math.tan(widest) == pytest.approx(
        math.hypot(math.tan(math.radians(17)) + 0.252, 0.252)
    )
    least = _mean_variance(settings, best, widest)
    assert least < 0.5 * _mean_variance(settings, 0 * best, widest)
    for number in range(len(best)):
        for change in (-3.0, 3.0):  # rad rms over the pillars
            moved = best + change * torch.eye(len(best), dtype=torch.float64)[number]
            assert _mean_variance(settings, moved, widest) > least


def _mean_variance(settings, place, widest):
    """rad² of wave fronts through the hole: rays straight from sources through glass,
    on places drawn in the stop.
    """
    draw = np.random.default_rng(4)
    total = []
    for share in (np.arange(9) + 0.5) / 9:
        tangent = math.tan(widest) * math.sqrt(share)
        sine = tangent / math.hypot(1, tangent)
        glass = 1.4525  # silica at 0.85 um
        inside = 500.0 * sine / math.sqrt(glass**2 - sine**2)
        polar = 500.0 * np.sqrt(draw.random(1500)), 2 * np.pi * draw.random(1500)
        x, y = inside + polar[0] * np.cos(polar[1]), polar[0] * np.sin(polar[1])
        there = torch.from_numpy(x)[None], torch.from_numpy(y)[None]
        carrier = SmoothWave(settings.focus, settings.aperture_mm * 500).carrier_rad(
            *there
        )
        phase = (carrier + phase_at(settings, place, *there))[0].numpy()
        # collimated but for 40 mm: its vergence is a sphere about the source, 39.8 mm
        # away in reduced distance
        reduced = 40000.0 - 500.0 * (1 - 1 / glass)
        far = np.sqrt((x + reduced * tangent) ** 2 + y**2 + reduced**2)
        near = np.sqrt((x - 2000.0 * tangent) ** 2 + y**2 + 2000.0**2)
        phase = phase + 2 * np.pi / 0.85 * (far + near)
        plane = np.stack([np.ones_like(x), x, y], 1)
        total.append(
            (phase - plane @ np.linalg.lstsq(plane, phase, rcond=None)[0]).var()
        )
    return float(np.mean(total))


def test_what_is_chosen_is_least_in_the_runs_that_choose_and_then_planned():
    device, lines = _scanned()
    roles = guide.compared(lines, device)
    assert roles == {
        "focus": "lens=focus70,field=oblique,fwhm=30",
        "designer": "lens=oblique150,field=oblique,fwhm=30",
        "asphere": "lens=radial-focus70,field=oblique,fwhm=30",
        "trained": "lens=free-focus70,field=oblique,fwhm=30",
    }
    designer = roles["designer"]
    better = guide.compared(lines | _line(f"{designer}/{guide.CHOICE}", 0.89), device)
    assert better["trained"] == "lens=free-oblique150,field=oblique,fwhm=30"
    assert better["asphere"] == roles["asphere"]
    assert {f"{cell}/4" for cell in roles.values()} <= set(guide.plan(lines))
    first = next(iter(lines))
    assert (
        guide.chosen({k: v for k, v in lines.items() if k != first}, device, "focus")
        is None
    )


def test_the_page_tells_ratios_to_best_focus_and_designer_and_what_is_missing():
    device, lines = _scanned()
    for seed in range(3):
        for role, share in (("focus", 1.0), ("designer", 0.9), ("trained", 0.72)):
            lines |= _line(
                f"{guide.compared(lines, device)[role]}/{seed}",
                share * (1 + seed),
                window=share,
            )
        lines |= _line(f"base/{seed}", 0.4) | _line(f"fwhm=30/{seed}", 0.5)
    rows = {row["role"]: row for row in told.device_rows(lines)[device]}
    assert rows["trained"]["axial_mm_ratio"].mean == pytest.approx(0.72)
    assert rows["trained"]["to_designer"].mean == pytest.approx(0.8)
    assert rows["focus"]["axial_mm"].mean == pytest.approx(
        2.0
    )  # without the run that chose
    page = told.page(lines)
    assert "Trained to the best designer's lens, axial: 0.80 [0.80, 0.80]." in page
    assert "| `fwhm=30` | 3 | 0.50 [0.50, 0.50] | 1.25 [1.25, 1.25] |" in page
    assert "`electrons=500`" in page.split("Planned and not measured")[1]
    assert "`fwhm=30`" not in page.split("Planned and not measured")[1]
    assert "3 to 29° along x" in page  # atan(tan 17° ± 504 / 2000)
    assert "±25° about the axis" in page


def test_a_run_trains_its_lens_once_and_goes_on_where_it_was(tmp_path, monkeypatch):
    tiny = ReaderConfig(frames=64, pool=32, test=32, pixels=32, pitch_um=36.0)
    monkeypatch.setattr(Cell, "config", property(lambda cell: tiny))
    monkeypatch.setattr(
        guide,
        "TRAINING",
        LensTraining(
            turns=1, hold=1, batch=4, phase=replace(guide.TRAINING.phase, start=0)
        ),
    )
    monkeypatch.setattr(guide, "IMAGE", 0.4)
    monkeypatch.setattr(guide, "TRAINED", 0.4)
    names = ["lens=radial-focus40,pitch=36/0", "lens=radial-focus40,pitch=36/1"]
    guide.run(tmp_path, names)
    first = (tmp_path / guide.LINES).read_bytes()
    assert [line["run"] for line in kept_lines(tmp_path / guide.LINES)] == names
    (design,) = kept_lines(tmp_path / guide.DESIGNS)
    assert len(design["coefficients_rad"]) == guide.RADIAL
    assert design["axial_mm"][str(design["turn"])] == min(design["axial_mm"].values())
    assert set(design["axial_mm"]) == {"0", "1"}  # before and after its one turn
    assert (
        any(design["coefficients_rad"])
        == (design["turn"] > 0)
        == (design["apart_rad"] > 0)
    )
    guide.run(tmp_path, names)
    assert (tmp_path / guide.LINES).read_bytes() == first
    other = tmp_path / "other"
    other.mkdir()
    keep_line(other / guide.DESIGNS, design)
    guide.run(other, names[1:])
    again, kept = (
        kept_lines(other / guide.LINES)[0],
        kept_lines(tmp_path / guide.LINES)[1],
    )
    assert {k: v for k, v in again.items() if k != "cpu_s"} == {
        k: v for k, v in kept.items() if k != "cpu_s"
    }


def test_a_lens_that_training_left_where_it_was_is_not_read_again(tmp_path):
    """Its runs, by either reader, and its bound are those of the start; a lens that
    moved is read.
    """
    for lens, turn in (("free-oblique40", 0), ("free-focus70", 24)):
        keep_line(
            tmp_path / guide.DESIGNS,
            {"design": f"lens={lens},field=line", "turn": turn},
        )
    keep_line(
        tmp_path / guide.BOUNDS, {"cell": "lens=oblique40,field=line", "bound_mm": 1.5}
    )
    lines = _line("lens=oblique40,field=line,frames=6400/3", 0.8) | _line(
        "lens=focus70,field=line/3", 0.9
    )
    found = guide.already_read(
        tmp_path, "lens=free-oblique40,field=line,frames=6400/3", lines
    )
    assert (found["axial_mm"], found["read_as"]) == (
        0.8,
        "lens=oblique40,field=line,frames=6400",
    )
    assert found["run"] == "lens=free-oblique40,field=line,frames=6400/3"
    assert guide.bounded(tmp_path, "lens=free-oblique40,field=line")["bound_mm"] == 1.5
    for name in (
        "lens=free-oblique40,field=line,frames=6400/2",
        "lens=free-focus70,field=line/3",
        "base/3",
    ):
        assert guide.already_read(tmp_path, name, lines) is None


def test_a_held_axis_of_the_field_has_the_psfs_of_its_middle():
    """Along y the outermost rows see one PSF; along x they differ, as in the field that
    is not held.
    """
    cell = cell_of("lens=focus30,field=line,pitch=31.5")
    settings = replace(guide.optics_of(cell), image_tolerance=0.4, window_samples=9)
    form = forms(FIELDS["line"].share)
    held, whole = (
        f(settings, torch.zeros(0), 44, margin=4) for f in (form, forms((1.0, 1.0)))
    )
    apart = [
        float((one.stack[0, 0] - one.stack[-1, 0]).norm() / one.stack[0, 0].norm())
        for one in (held, whole)
    ]
    assert apart[0] < 2e-3  # a thousandth of the field
    assert apart[1] > 0.1
    across = [
        float((one.stack[0, 0] - one.stack[0, -1]).norm() / one.stack[0, 0].norm())
        for one in (held, whole)
    ]
    assert across[0] > 0.1
    middle = 2000 * math.tan(math.radians(17.0))
    reach = (held.plan.x_um[-1] - held.plan.x_um[0]) / 2
    assert float(held.plan.x_um.mean()) == pytest.approx(
        middle, abs=60
    )  # nodes lie denser on one side
    assert float(reach) == pytest.approx(31.5 * 43 / 2, rel=0.02)
    assert held.plan.y_um.abs().max() < 1.0


def test_a_bound_is_the_prior_without_information_and_the_blur_with_much():
    """1 / √(J + 1/9): J = 0 gives 3 mm, 7/144 gives 12/√23 mm, much gives 1/√J."""
    assert bound.spread_mm(torch.zeros(4)) == pytest.approx(3.0)
    assert bound.spread_mm(torch.full((2, 3), 7 / 144)) == pytest.approx(
        12 / math.sqrt(23)
    )
    assert bound.spread_mm(torch.tensor([1e4, 4e4])) == pytest.approx(0.0075, rel=1e-3)


def test_the_bound_is_taken_at_the_middles_of_the_readers_windows():
    """56 pixels: windows of 14 that overlap by half; their middles lie 7 pixels apart
    about that of the field.
    """
    cell = cell_of("field=oblique")
    at = bound.centres_um(guide.optics_of(cell), cell.config, (0.5, 1.0)).reshape(
        7, 7, 2
    )
    assert float(at[3, 3, 0]) == pytest.approx(2000 * math.tan(math.radians(17.0)))
    assert (at[3, 4] - at[3, 3]).tolist() == pytest.approx([126.0, 0.0])
    assert (at[6, 2] - at[3, 2]).tolist() == pytest.approx([0.0, 189.0])


def test_the_bound_tells_a_lens_that_blurs_with_depth_from_one_that_hardly_does():
    """A wide aperture moves its blur with depth more than a narrow one of a fifth: it
    tells more.
    """
    cell = cell_of("lens=focus30,field=angle,pitch=31.5")
    config, share = ReaderConfig(pixels=32, pitch_um=31.5), FIELDS["angle"].share
    found = []
    for aperture in (0.7, 0.14):
        settings = replace(
            guide.optics_of(cell),
            aperture_mm=aperture,
            image_tolerance=0.4,
            window_samples=9,
        )
        whole = forms(share)(settings, torch.zeros(0), 40, margin=4)
        found.append(bound.bound_mm(settings, torch.zeros(0), whole, config, share))
    assert found[0] < 0.9 * found[1]
    assert (
        0.99 * bound.PRIOR_MM < found[1] <= bound.PRIOR_MM
    )  # of so narrow a lens no blur is seen


@pytest.mark.slow
def test_the_network_reads_the_frames_that_judge_the_reader(monkeypatch):
    """The lens stands; errors are below those of answers from anywhere in the range."""
    tiny = ReaderConfig(frames=32, pool=32, test=32, pixels=32, pitch_um=31.5, seed=3)
    kept, gaze_deg = [], network.gaze_deg
    monkeypatch.setattr(network, "PEOPLE", 2)
    monkeypatch.setattr(network, "EACH", 16)
    monkeypatch.setattr(
        network, "gaze_deg", lambda *given: kept.append(given[0]) or gaze_deg(*given)
    )
    cell = cell_of("lens=oblique30,field=oblique,pitch=31.5,reader=network")
    settings, place = (
        replace(guide.optics_of(cell), image_tolerance=0.4, window_samples=9),
        guide.start_of(cell),
    )
    judge = guide.scenery(tiny).judge
    found = network.read(settings, place, judge, tiny)
    truth = judge.batch(0, 32).slip_mm
    assert 0 < found["axial_mm"] < 3 * float(truth[:, 2].abs().mean())
    assert found["trusted_mm"] != found["window_mm"]
    assert 0 < found["gaze_deg"] < 60
    assert torch.equal(kept[0].model.coefficients_rad.detach(), place)


def test_the_page_has_the_rungs_with_bounds_and_the_network():
    lines = {}
    for rung, share in zip(guide.LADDER, (0.6, 0.8, 1.1), strict=True):
        lines |= _scanned(rung)[1]
        roles = guide.compared(lines, rung)
        for seed in range(2):
            for role, part in (("focus", 1.0), ("designer", 0.8), ("trained", share)):
                lines |= _line(f"{roles[role]}/{seed}", part * (1 + seed), window=part)
    for seed in range(2):
        for role, part in (("focus", 1.0), ("designer", 0.5), ("trained", 0.9)):
            name = f"{guide.watched(lines)[role]}/{seed}"
            lines |= {
                name: _line(name, part)[name]
                | {"gaze_deg": 2 * part, "mmacs": 3.3, "iou": 0.8}
            }
    roles = guide.compared(lines, guide.LADDER[0])
    page = told.page(lines, {roles["trained"]: 0.9, roles["focus"]: 1.2})
    want = "| `angle` | `focus70` | `oblique150` | 1.50 [-4.85, 7.85] | 0.80 [0.80, 0.80] | 0.60 [0.60, 0.60] | 0.75 ["
    assert want in page
    assert page.split(want)[1].splitlines()[0].endswith("| 0.75 |")
    assert (
        "| trained: `free-focus70` | 3.30 | 2 | 0.90 [0.90, 0.90] | 0.90 [0.90, 0.90] |"
        in page
    )
    assert "by the network: 1.80 [1.80, 1.80]" in page
    assert "| 1.80 [1.80, 1.80] | 0.90 [0.90, 0.90] |\n" in page


@pytest.mark.parametrize("which", [0, 1])
def test_lenses_read_after_more_frames_have_a_table_beside_that_of_fewer(which):
    """Ratios of a focus of 0.5 mm and a designer's of 0.4 after many frames, 2.0 and
    2.6 after few: 0.8, and 1.3.
    """
    device, lines = _scanned(guide.LONG_READ[which])
    few, many = guide.compared(lines, device), guide.long_read(lines, device)
    assert not guide.long_read(lines, guide.LADDER[1])
    assert set(many) == set(few) - {"asphere"}
    assert {cell_of(cell).frames for cell in many.values()} == {25_600}
    assert set(many.values()) <= {name.rpartition("/")[0] for name in guide.plan(lines)}
    for seed in range(2):
        for role, before, after in (("focus", 2.0, 0.5), ("designer", 2.6, 0.4)):
            lines |= _line(f"{few[role]}/{seed}", before * (1 + seed)) | _line(
                f"{many[role]}/{seed}", after
            )
    lens = cell_of(few["designer"]).lens
    above, _, below = told.page(lines).partition(
        f"### {cell_of(device).field}, 30 nm, after more frames"
    )
    table = (
        f"designer: `{lens}` | 2 | 3.90 [-12.62, 20.42] | 1.30 [1.30, 1.30]",
        "| 3.00 [-9.71, 15.71] | 1.30 [1.30, 1.30]",
    )
    assert table[which] in above
    assert f"designer: `{lens}` | 2 | 0.40 [0.40, 0.40] | 0.80 [0.80, 0.80]" in below


def test_the_page_says_what_a_training_kept_and_keeps_rungs_without_one():
    """A rung with a best focus and a designer's lens alone has its row; numbers of a
    trained lens are dashes.
    """
    device, lines = _scanned(guide.LADDER[0])
    for seed in range(2):
        for role, share in (("focus", 1.0), ("designer", 0.8)):
            lines |= _line(f"{guide.compared(lines, device)[role]}/{seed}", share)
    kept = {
        "design": "lens=free-focus70",
        "turn": 0,
        "axial_mm": {"0": 1.0443, "24": 1.0452},
        "apart_rad": 0.0,
    }
    moved = kept | {"design": "lens=free-focus40", "turn": 24, "apart_rad": 0.613}
    page = told.page(lines, designs=[kept, moved])
    assert "| 0.80 [0.80, 0.80] | – | – | – | – | – |\n" in page
    said = "axial 1.044 mm after 0 turns, 1.045 mm after 24 turns, on the frames that choose; "
    assert f"`lens=free-focus70`: {said}kept the start" in page
    assert (
        f"`lens=free-focus40`: {said}kept after 24, 0.61 rad rms from the start."
        in page
    )


def test_a_plan_goes_on_from_the_committed_results(tmp_path):
    """All lines come over as they are; a folder that has lines keeps them."""
    guide.begin(tmp_path)
    kept = json.loads(guide.RESULT.read_text("utf-8"))
    assert kept_lines(tmp_path / guide.LINES) == kept["runs"]
    assert kept_lines(tmp_path / guide.DESIGNS) == kept["designs"]
    with pytest.raises(SystemExit, match=r"already holds runs\.jsonl, designs\.jsonl"):
        guide.begin(tmp_path)
    assert kept_lines(tmp_path / guide.LINES) == kept["runs"]
