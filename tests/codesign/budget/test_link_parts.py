"""What goes into every link: tables, settings, draws and steps, seen on stand-ins that only remember."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.budget import links, plan, prepared, task
from codesign.budget.entry import NONE, Entry, total
from codesign.budget.task import TaskSetting
from codesign.eye import POPULATION
from codesign.optics import Numerics
from metalens.ground.errors import LensError
from metalens.image import Frames

RNG = np.random.default_rng(31)


def test_the_sum_is_the_root_of_the_squares_of_what_counts():
    found = [
        Entry("a", 0.2, NONE, 0.03, ""), Entry("b", 0.3, 0.5, 0.04, ""), Entry("c", 0.6, 1.2, NONE, ""),
        Entry("d", 9.0, 9.0, 9.0, "", counted=False),
    ]  # fmt: skip
    got = total(found)
    assert (got.phase_rad, got.psf, got.gaze_rad) == pytest.approx((0.7, 1.3, 0.05))
    assert got.method.endswith("without c")


def test_the_phase_of_a_link_is_its_scatter_about_the_mean_over_the_pillars():
    """0.4, 0.1 and -0.8 rad in shares of 0.5, 0.3 and 0.2, a common turn that wraps left out."""
    share, off = np.array([0.5, 0.3, 0.2]), np.array([0.4, 0.1, -0.8])
    common = np.angle((np.exp(1j * off) * share).sum())
    want = math.sqrt((((off - common) ** 2) * share).sum())
    for turn in (0.0, 2.9, -3.0):
        assert links._spread_of(off + turn, share) == pytest.approx(want, rel=1e-9)


def about(**more):
    """A bench that answers each change of the device with what it was given."""
    known = {
        "device": SimpleNamespace(image=lambda **given: given),
        "entry": lambda link, optics, method, phase_rad=NONE: Entry(link, phase_rad, 0.1, 0.2, repr(optics)),
        "lens": SimpleNamespace(wavelength_um=0.85, cell=SimpleNamespace(pitch_um=0.42)),
    }
    return SimpleNamespace(**known | more)


def test_a_changed_table_is_told_by_its_turn_from_the_designed_one(monkeypatch):
    designed = np.array([0.9, 0.8j, -0.7])
    turn = np.array([0.3, -0.2, 0.05])
    share = np.array([0.2, 0.7, 0.1])
    aperture = SimpleNamespace(designed=lambda: designed, share=share, maps=lambda table: (table, "level"))
    monkeypatch.setattr(links, "gathered", lambda lens, *maps: maps)
    got = links._changed(about(aperture=aperture), "proxy", designed * np.exp(1j * turn), "said")
    assert got.phase_rad == pytest.approx(links._spread_of(turn, share))
    assert "level" in got.method


@pytest.mark.parametrize("stored", [False, True])
def test_pillars_are_solved_thirty_times_as_precisely_at_twelve_diameters(monkeypatch, stored):
    """Without a library: exact over proxy, at once; with it exact over stored, then stored over proxy."""
    lens = SimpleNamespace(
        cell="cell",
        wavelength_um=0.85,
        proxy=SimpleNamespace(
            transmission=lambda d, wave: 0.9 - d, phase_rad=lambda d, wave: 3.0 * d * wave, domain_um=(0.1, 0.3)
        ),
    )
    asked, carried = [], []

    def precise(cell, light, *, tolerance, engine):
        asked.append((cell, light.wavelength_um, tolerance, engine))
        return lambda d: SimpleNamespace(t=0.8 * np.exp(1j * d))

    monkeypatch.setattr(links.supercell, "printed", lambda lens: (0.11, 0.27))
    monkeypatch.setattr(links.engines, "choose", lambda cell: "modal")
    monkeypatch.setattr(links.engines, "precise", precise)
    monkeypatch.setattr(links, "_stored", lambda library, at, wave: 0.7 * np.exp(2j * at))
    monkeypatch.setattr(links, "_carried", lambda about, at, ratio: carried.append((at, ratio)))
    monkeypatch.setattr(links, "_changed", lambda about, link, table, method: link)
    library = SimpleNamespace(sweep=SimpleNamespace(tolerance=6e-3)) if stored else None
    given = SimpleNamespace(library=library, tolerance=1.5e-3)
    names = list(links._pillars(about(lens=lens, given=given)))
    assert asked == [("cell", 0.85, pytest.approx((6e-3 if stored else 1.5e-3) / 30), "modal")]
    at = np.linspace(0.11, 0.27, 12)
    exact, held = 0.8 * np.exp(1j * at), 0.7 * np.exp(2j * at)
    proxy = (0.9 - at) * np.exp(1j * 3.0 * at * 0.85)
    want = [exact / held, held / proxy] if stored else [exact / proxy]
    assert names == (["pillar solver", "proxy"] if stored else ["pillar solver and proxy"])
    for (place, ratio), one in zip(carried, want, strict=True):
        assert place == pytest.approx(at)
        assert ratio == pytest.approx(one, rel=1e-12)


def test_neighbours_go_onto_the_pillars_and_turn_those_that_are_built(monkeypatch):
    """Rows solved here where the lens holds none; where it does, what is open of them, as squares."""
    place = np.array([[3, 1], [0, -1]])  # the last site is empty
    sine = np.array([[0.1, 0.2], [0.3, 0.9]])

    def rows(slope):
        sines = np.array([0.85 / 0.42 / 6, 0.2])
        aside = np.array([False, True])
        return SimpleNamespace(mean=lambda s: np.exp(1j * slope * s), sine=sines, diagonal=aside)

    monkeypatch.setattr(links.supercell, "neighbours", lambda lens: rows(-0.7))
    monkeypatch.setattr(links, "gathered", lambda lens, *maps: (lens.neighbours, maps))
    monkeypatch.setattr(links, "replace", lambda lens, neighbours: SimpleNamespace(neighbours=neighbours))
    aperture = SimpleNamespace(turn_sine=lambda: sine, designed=lambda: "t", maps=lambda table: (table,), place=place)
    seen = []
    bench = about(aperture=aperture)
    bench.lens.neighbours = None
    bench.device.image = lambda *, wave: seen.append(wave)
    (got,) = links._neighbours(bench)
    assert got.phase_rad == pytest.approx(0.7 * np.std([0.1, 0.2, 0.3]), rel=1e-9)
    assert seen[0][1] == ("t",)
    held = rows(-0.7)
    held.doubted = lambda sines: [rows(-0.4), rows(-0.9)] if sines is sine else None
    bench.lens.neighbours = held
    (got,) = links._neighbours(bench)
    assert got.phase_rad == pytest.approx(math.hypot(0.3, 0.2) * np.std([0.1, 0.2, 0.3]), rel=1e-9)
    assert "lens file" in got.method


def test_the_mask_rounds_every_diameter_to_its_step(monkeypatch):
    rounded = []
    aperture = SimpleNamespace(designed=lambda: "t", rounded=lambda table, step_um: rounded.append((table, step_um)))
    monkeypatch.setattr(links, "_changed", lambda about, link, table, method: method)
    given = SimpleNamespace(mask=SimpleNamespace(diameter_step_nm=4.0))
    assert list(links._mask(about(aperture=aperture, given=given))) == ["every diameter rounded to 4 nm"]
    assert rounded == [("t", pytest.approx(4e-3))]
    assert list(links._mask(about(given=SimpleNamespace(mask=None)))) == []


def test_made_lenses_err_by_their_phase_about_the_designed_one(monkeypatch):
    """A table that turns by 0.1 and -0.2, a bend on the places over the radius; the empty site counts for nothing."""
    place = np.array([[0, 1, 0], [1, -1, 1]])
    built = place >= 0
    x_um, y_um = np.array([-1.0, 0.5, 2.0]), np.array([-0.7, 1.9])
    designed, turned = np.array([0.3, 0.9]), np.array([0.4, 0.7])
    maps = []

    def mapped(table, bias_um=0.0):
        maps.append(bias_um)
        return torch.from_numpy(np.where(built, table[place], 0.0)), "level"

    bends = 0.2 * (x_um[None, :] / 4.0) - 0.5 * (y_um[:, None] / 4.0) ** 2
    state = SimpleNamespace(
        answers=lambda: "answers", bias_um=lambda u, v: 1e-3 * u - 2e-3 * v, bends=lambda: True,
        phase_rad=lambda u, v: 0.2 * u - 0.5 * v**2,
    )  # fmt: skip
    monkeypatch.setattr(links, "sensitivity", lambda lens: "response")
    monkeypatch.setattr(links, "transmission", lambda *given: turned)
    monkeypatch.setattr(links, "gathered", lambda lens, phase, level: phase)
    seen = []
    lens = SimpleNamespace(
        wavelength_um=0.85, proxy=None, diameters=SimpleNamespace(x_um=x_um, y_um=y_um, radius_um=4.0)
    )
    aperture = SimpleNamespace(place=place, designed=lambda: designed, diameter_um=None, maps=mapped)
    bench = about(lens=lens, aperture=aperture)
    bench.device.image = lambda *, wave, shift_um: seen.append((wave, shift_um))
    got = links._drawn(bench, "process spread", [links.Made(state, 1.7)], "drawn")
    off = np.where(built, (turned - designed)[place] + bends, 0.0)
    assert got.phase_rad == pytest.approx(np.std(off[built]), rel=1e-5)  # about the mean on the circle
    assert maps[1] == pytest.approx(1e-3 * x_um[None, :] / 4 - 2e-3 * y_um[:, None] / 4 + np.zeros((2, 3)))
    assert seen[0][1] == 1.7
    assert seen[0][0].numpy() == pytest.approx(np.where(built, turned[place] + bends, 0.0), abs=1e-6)


def test_draws_of_a_fit_count_from_its_best_estimate(monkeypatch):
    best = np.arange(float(max(links.PLACE.values()) + 1))
    drawn, seeds = [best + 0.1, best - 0.4], []
    diameters = SimpleNamespace(diameter_um=np.array([[0.2, 0.1]]))
    fitted = SimpleNamespace(
        design=SimpleNamespace(diameters=diameters),
        parameters=lambda row=None: best if row is None else row,
        lens_samples=lambda count, *, seed: seeds.append(seed) or drawn[:count],
    )
    made = []
    monkeypatch.setattr(links, "state", lambda off: off)
    monkeypatch.setattr(links, "_drawn", lambda about, link, lenses, method: made.extend(lenses))
    list(
        links._calibration(
            about(given=SimpleNamespace(asbuilt=fitted, draws=2), lens=SimpleNamespace(diameters=diameters))
        )
    )
    assert [one.state for one in made] == [pytest.approx(np.full(best.size, v)) for v in (0.1, -0.4)]
    assert [one.shift_um for one in made] == pytest.approx([0.1, -0.4])
    assert seeds == [3]  # the same draws for every lens


def test_the_process_is_drawn_as_often_as_asked_and_without_a_mask_not_at_all(monkeypatch):
    asked, made = [], []

    def draws(spread, count, *, seed):
        asked.append((spread, count, seed))
        return [SimpleNamespace(state=lambda k=k: f"state {k}") for k in range(count)]

    monkeypatch.setattr(links, "draws", draws)
    monkeypatch.setattr(links, "_drawn", lambda about, link, lenses, method: made.extend(lenses) or (link, method))
    got = list(links._spread(about(given=SimpleNamespace(mask=SimpleNamespace(spread="its spread"), draws=3))))
    assert asked == [("its spread", 3, 5)]
    assert [(one.state, one.shift_um) for one in made] == [(f"state {k}", 0.0) for k in range(3)]
    assert got == [("process spread", "3 draws of the process, lens not measured")]
    assert not list(links._spread(about(given=SimpleNamespace(mask=None, draws=3))))
    assert len(asked) == 1


@pytest.mark.parametrize(("off_um", "shape", "refused"), [(8e-7, 3, False), (1.2e-5, 3, True), (0.0, 4, True)])
def test_a_fit_of_another_lens_is_refused(monkeypatch, off_um, shape, refused):
    """Diameters are told apart by a picometre and 1e-5 of themselves."""
    own, other = np.full((3, 3), 0.2), np.full((shape, 3), 0.2)
    other[1, 2] += off_um
    fitted = SimpleNamespace(
        design=SimpleNamespace(diameters=SimpleNamespace(diameter_um=other)),
        parameters=lambda row=None: np.zeros(len(links.PLACE)),
        lens_samples=lambda count, seed: [None] * count,
    )
    lens = SimpleNamespace(diameters=SimpleNamespace(diameter_um=own))
    monkeypatch.setattr(links, "_drawn", lambda about, link, lenses, method: len(lenses))
    told = links._calibration(about(lens=lens, given=SimpleNamespace(asbuilt=fitted, draws=2)))
    if refused:
        with pytest.raises(LensError, match="another lens"):
            list(told)
    else:
        assert list(told) == [2]


def test_numerics_change_one_setting_of_the_finest_each(monkeypatch):
    finest = Numerics(40, 8, 1e-6, 2e-5)
    given = SimpleNamespace(numerics=Numerics(11, 3, 4e-4, 6e-3), fwhm_nm=30.0)
    monkeypatch.setattr(links, "psf_difference", lambda optics, other, window: (optics, other, window))
    bench = about(
        given=given,
        finest=finest,
        window="window",
        basis=lambda n: n,
        shift=lambda one, other: torch.tensor([[3.0, 4.0, 9.0]]),
    )
    found = list(links._numerics(bench))
    assert [entry.link for entry in found] == ["propagation", "depth sampling", "wavelength sampling", "image kernels"]
    changes = [{"psf_tolerance": 4e-4}, {"depth_count": 11}, {"wavelength_count": 3}, {"basis_tolerance": 6e-3}]
    assert [entry.psf for entry in found] == [(replace(finest, **c), finest, "window") for c in changes]
    assert [entry.gaze_rad for entry in found] == pytest.approx([5.0] * 4)
    given.fwhm_nm = 0.0
    assert len(list(links._numerics(bench))) == 3


@pytest.mark.parametrize(
    ("numerics", "fwhm", "want"),
    [
        (Numerics(12, 3, 1e-3, 1e-2), 30.0, Numerics(24, 9, 1e-5, 1e-4)),
        (Numerics(40, 3, 2e-5, 3e-4), 0.0, Numerics(64, 1, 2e-6, 3e-5)),
    ],
)
def test_the_finest_numerics_are_twice_the_depths_and_ten_times_the_tolerances(monkeypatch, numerics, fwhm, want):
    made = {}
    lens = SimpleNamespace(sensor_distance_um=1900.0, reduced_um=1733.0, wavelength_um=0.81, layers="layers")
    eyes = SimpleNamespace(depths_um=(15e3, 31e3))
    monkeypatch.setattr(task, "views", lambda setting: eyes)
    aperture = SimpleNamespace(designed=lambda: "t", maps=lambda table: ("phase", "level"))
    monkeypatch.setattr(prepared, "Aperture", lambda lens: aperture)
    monkeypatch.setattr(prepared, "gathered", lambda lens, *maps: "wave")
    monkeypatch.setattr(
        prepared, "device", lambda wave, grid, **more: made.update(grid=grid, **more) or SimpleNamespace(whole=1)
    )
    monkeypatch.setattr(task, "linear", lambda eyes, optics, setting: setting)
    got = prepared.bench(
        lens, prepared.Given(numerics=numerics, fwhm_nm=fwhm), TaskSetting(pixels=44, margin=7, pitch_um=13.0)
    )
    assert (got.finest.depth_count, got.finest.wavelength_count) == (want.depth_count, want.wavelength_count)
    assert got.finest.psf_tolerance == pytest.approx(want.psf_tolerance)
    assert got.finest.basis_tolerance == pytest.approx(want.basis_tolerance)
    assert got.setting.sensor_distance_um == 1733.0  # the eyes are seen as behind the films
    grid = made["grid"]
    assert (grid.samples, grid.step_um, grid.depths_um) == ((44, 44), 13.0, (15e3, 31e3))
    assert (grid.margin, grid.window) == (7, 15)
    assert made["distance_um"] == 1900.0
    assert (made["spectrum"] is None) == (fwhm == 0)
    if fwhm:
        assert (made["spectrum"].peak_nm, made["spectrum"].fwhm_nm) == (pytest.approx(810.0), 30.0)
    assert (got.window.near_um, got.window.far_um, got.window.pitch_um) == (15e3, 31e3, 13.0)


def test_every_unknown_is_moved_alone_by_its_step():
    """Gaze, slippage, size, then every trait that varies; both sides, half the central difference each."""

    @dataclass(frozen=True)
    class Eyes:
        gaze_rad: torch.Tensor
        slip_um: torch.Tensor
        scale: torch.Tensor
        traits: torch.Tensor

    still = Eyes(*(torch.from_numpy(RNG.normal(size=s)) for s in ((2, 2), (2, 3), (2,), (2, len(POPULATION)))))
    places = [("gaze_rad", 0), ("gaze_rad", 1), ("slip_um", 0), ("slip_um", 1), ("slip_um", 2), ("scale", None)]
    places += [("traits", list(POPULATION).index(name)) for name in task.TRAITS]
    for unknown, (field, column) in enumerate(places):
        amount = 0.3 + unknown
        moved = task.shifted(still, unknown, amount)
        for name in ("gaze_rad", "slip_um", "scale", "traits"):
            off = getattr(moved, name) - getattr(still, name)
            want = torch.zeros_like(off)
            if name == field:
                want[... if column is None else (slice(None), column)] = amount
            assert off.numpy() == pytest.approx(want.numpy(), abs=1e-12)
    steps, widths = task._steps(), task._priors()
    assert len(steps) + 1 == len(widths) == len(task.NAMES)
    assert steps[:6] == pytest.approx((3.4906585e-4, 3.4906585e-4, 5, 5, 5, 1e-3))
    assert widths[:6] == (0.18, 0.13, 1200.0, 900.0, 2000.0, 0.12)
    assert widths[-1] == 0.3
    assert steps[6:] == pytest.approx([0.005 * POPULATION[name].sd for name in task.TRAITS])
    assert widths[6:-1] == tuple(POPULATION[name].sd for name in task.TRAITS)
    assert np.diag(task._precision().numpy()) == pytest.approx(np.array(widths) ** -2.0)


def test_pixels_are_means_of_three_by_three_rays_and_depths_of_what_covers(monkeypatch):
    fine = Frames(
        *(torch.from_numpy(RNG.uniform(0, 1, (1, 2, 12, 12))) for _ in range(2)),
        torch.from_numpy(RNG.uniform(15e3, 30e3, (1, 2, 12, 12))),
    )
    fine.coverage[0, 0, :3, :3] = 0  # nothing covers the first pixel of the near sheet
    asked = []

    def render(states, *, rig, camera, exposed):
        asked.append((states, camera, exposed))
        return SimpleNamespace(frames=fine)

    monkeypatch.setattr(task, "render", render)
    got = task._frames("now", "then", TaskSetting(pixels=2, margin=1, pitch_um=21.0))
    (states, camera, exposed) = asked[0]
    assert (states, exposed, camera.pixels, camera.pitch_um) == ("now", "then", 12, 7.0)

    def mean(v):
        return v.numpy().reshape(1, 2, 4, 3, 4, 3).mean((3, 5))

    cover = mean(fine.coverage)
    depth = mean(fine.coverage * fine.depth_um) / np.where(cover > 0, cover, 1)
    depth[0, 0, 0, 0] = fine.depth_um[0, 0, :3, :3].mean()
    assert got.radiance.numpy() == pytest.approx(mean(fine.radiance))
    assert got.coverage.numpy() == pytest.approx(cover)
    assert got.depth_um.numpy() == pytest.approx(depth)


def test_what_is_seen_spans_the_depths_that_something_covers():
    depth = torch.tensor([3e3, 7e3, 22e3, 90e3]).reshape(1, 2, 1, 2)
    cover = torch.tensor([0.0, 0.1, 1.0, 0.0]).reshape(1, 2, 1, 2)
    assert task.Views(Frames(cover, cover, depth), ()).depths_um == (7e3, 22e3)
    near = torch.tensor([3e3, 4e3, 3e3, 5e3]).reshape(1, 2, 1, 2)
    assert task.Views(Frames(cover, cover + 0.1, near), ()).depths_um == (5e3, 6e3)


def test_a_mean_gaze_error_is_of_angles_over_eyes():
    shift = torch.tensor([[0.3, -0.4, 9.0], [0.0, 1.2, 9.0]])
    assert task.gaze_mean(shift) == pytest.approx((0.5 + 1.2) / 2)
    draws = torch.stack([shift, 2 * shift, 5 * shift])
    assert task.gaze_mean(draws) == pytest.approx(8 / 3 * (0.5 + 1.2) / 2)
    assert task.gaze_rms(draws) == pytest.approx(math.sqrt(30 / 3 * (0.25 + 1.44) / 2))


def test_views_are_of_both_sides_of_every_unknown(monkeypatch):
    monkeypatch.setattr(task, "shifted", lambda states, unknown, amount: (states, unknown, amount))
    monkeypatch.setattr(task, "_frames", lambda states, lit, setting: (states, lit, setting))
    made = task.views("setting", "states", exposed="lit")
    assert made.anchor == ("states", "lit", "setting")
    steps = task._steps()
    assert made.moved == tuple(
        ((("states", k, step), "lit", "setting"), (("states", k, -step), "lit", "setting"))
        for k, step in enumerate(steps)
    )
    assert task.views("setting", "states").anchor == ("states", "states", "setting")


@pytest.mark.parametrize(
    ("off", "refused"),
    [
        ((1.019, 1, 1), False),
        ((1.021, 1, 1), True),
        ((1, 0.979, 1), True),
        ((1, 1, 1.021), True),
        ((1, 1, 0.981), False),
    ],
)
def test_a_reader_of_another_lens_is_refused_beyond_two_per_cent(off, refused):
    """Sensor distance, wavelength and aperture of the lens against those of the run, in its units."""
    lens = SimpleNamespace(
        sensor_distance_um=1900.0 * off[0], wavelength_um=0.81 * off[1],
        diameters=SimpleNamespace(radius_um=350.0 * off[2]),
    )  # fmt: skip
    optics = SimpleNamespace(sensor_distance_mm=1.9, wavelength_nm=810.0, aperture_mm=0.7)
    run = SimpleNamespace(settings=SimpleNamespace(optics=optics))
    if refused:
        with pytest.raises(LensError, match="trained before another lens"):
            prepared._same(lens, run)
    else:
        prepared._same(lens, run)


def test_an_estimate_comes_to_rest_by_gauss_newton(monkeypatch):
    """Images g (linear in the unknowns) with g a brightness: one step, then one about it, by least squares in numpy."""
    count, pixels = len(task.NAMES), 60
    unit = np.array(task._priors())
    base = RNG.uniform(300, 500, (2, pixels))
    slopes = RNG.normal(0, 9, (2, count - 1, pixels)) / unit[:-1, None]

    def expected(x):
        return base + np.einsum("sk,skp->sp", x[:, :-1], slopes)

    class Estimator:
        def __init__(self, x):
            columns = np.concatenate([slopes, expected(x)[:, None]], 1)
            normal = columns @ columns.swapaxes(1, 2) / 400.0 + np.diag(unit**-2.0)
            self.image, self.covariance = torch.from_numpy(expected(x)), torch.from_numpy(np.linalg.inv(normal))
            self.pull = torch.from_numpy(np.linalg.inv(normal) @ columns / 400.0)

        def shift(self, image):
            return torch.einsum("skp,sp->sk", self.pull, image - self.image)

    monkeypatch.setattr(task, "linear", lambda seen, optics, setting: Estimator(seen))
    monkeypatch.setattr(task, "shifted", lambda x, k, amount: x + np.eye(count)[k] * amount.numpy()[:, None])
    monkeypatch.setattr(task, "views", lambda setting, moved, *, exposed: moved)
    start = np.zeros((2, count))
    image = expected(RNG.normal(0, 0.1, (2, count)) * unit) * np.array([[1.02], [0.97]])
    got = task.settle(torch.from_numpy(image), None, start, None, seen=start, steps=3)
    x = start
    for _ in range(3):
        about_x = x.copy()
        about_x[:, -1] = 0
        made = Estimator(about_x)
        pulled = np.einsum("skp,sp->sk", made.pull.numpy(), image / (1 + x[:, -1:]) - made.image.numpy())
        x = x + pulled - np.einsum("skl,sl->sk", made.covariance.numpy(), x / unit**2)
    assert got.numpy() / unit == pytest.approx(x / unit, abs=1e-9)
    assert np.abs(x / unit).max() > 0.05


def chain(**more):
    levels = {"library_tolerance": (3e-2, 1e-2, 1e-4), "diameter_step_nm": (20, 5, 2), "depth_count": (4, 8, 12)}
    aperture = SimpleNamespace(
        diameter_um=np.array([0.10, 0.14, 0.2, 0.26]), share=np.array([0.0, 0.3, 0.5, 0.2]),
        rounded=lambda table, step_um: ("rounded", step_um),
    )  # fmt: skip
    known = {
        "levels": levels,
        "aperture": aperture,
        "optics": lambda table, numerics: (table, numerics),
        "table": lambda tolerance: ("table", tolerance),
        "electrons": lambda optics: ("seen", optics),
        "config": SimpleNamespace(task=SimpleNamespace(scenes=3), stacks=7, frames=500),
        "around": plan.PILOT,
    }
    return SimpleNamespace(**known | more)


def test_mask_steps_are_tried_on_rounded_pillars_and_cost_by_their_classes(monkeypatch):
    """Classes over the diameters that occur, 0.14 to 0.26 um: 120 nm by the step, and one, at 3 ms each."""
    asked = []
    monkeypatch.setattr(
        plan, "_misread", lambda chain, truth, believed: asked.append((truth, believed)) or np.zeros((3, 2))
    )
    errors, seconds = plan._mask_knob(chain(), "believed", "exact")
    assert seconds == pytest.approx(0.003 * np.array([7, 25, 61]))
    assert [t[0] for t, _ in asked] == [("rounded", pytest.approx(s * 1e-3)) for s in (20, 5, 2)]
    assert {b for _, b in asked} == {"believed"}
    assert errors.shape == (3, 3, 2)


def test_libraries_are_tried_but_the_finest_which_is_the_truth(monkeypatch):
    asked = []
    monkeypatch.setattr(
        plan, "_misread", lambda chain, truth, believed: asked.append((truth, believed)) or np.full((3, 2), 0.1)
    )
    spent = {3e-2: 4.0, 1e-2: 2.5}
    errors, seconds = plan._library_knob(chain(library=lambda t: (None, spent[t])), "truth", 11.0)
    assert seconds.tolist() == [4.0, 4.0, 11.0]  # a finer one is not taken as cheaper
    assert errors[:2].tolist() == np.full((2, 3, 2), 0.1).tolist()
    assert not errors[2].any()
    assert asked == [("truth", (("table", t), plan.PILOT)) for t in (3e-2, 1e-2)]


@pytest.mark.parametrize("knob", ["depth_count", "kernel_tolerance"])
def test_settings_of_the_optics_are_judged_by_the_finest_of_them(monkeypatch, knob):
    """Kernels are timed by an image over its scenes, at 48 depths; the rest by a stack."""
    asked, times = [], iter([0.9, 0.6, 1.5])
    levels = {"depth_count": (4, 8, 12), "kernel_tolerance": (1e-1, 1e-2, 1e-4)}
    monkeypatch.setattr(
        plan, "_misread", lambda chain, truth, believed: asked.append((truth, believed)) or np.full((3, 2), 0.1)
    )
    monkeypatch.setattr(plan, "_fastest", lambda work: next(times))
    errors, seconds = plan._optics_knob(chain(levels=levels), "exact", knob)
    share = 3 if knob == "kernel_tolerance" else 1
    assert seconds == pytest.approx(np.array([0.9, 0.9, 1.5]) / share)
    around = replace(plan.PILOT, depth_count=48) if knob == "kernel_tolerance" else plan.PILOT
    name = "basis_tolerance" if knob == "kernel_tolerance" else "depth_count"
    made = [("exact", replace(around, **{name: v})) for v in levels[knob]]
    assert asked == [(made[2], made[0]), (made[2], made[1])]
    assert errors[2].tolist() == np.zeros((3, 2)).tolist()


def test_tolerances_of_the_true_image_cost_all_psfs_and_all_images_of_the_run(monkeypatch):
    """7 sets of PSFs, 500 images of which three scenes are timed at once; a finer tolerance is not taken as cheaper."""
    asked, times = [], iter([2.0, 0.3, 1.0, 0.6, 5.0, 0.9])
    monkeypatch.setattr(
        plan, "_misread", lambda chain, truth, believed: asked.append((truth, believed)) or np.full((3, 2), 0.1)
    )
    monkeypatch.setattr(plan, "_fastest", lambda work: next(times))
    monkeypatch.setattr(plan, "nodes_of", lambda optics: (optics[1] * 10, 5.0, 4.0, 1.0))
    errors, seconds, nodes = plan._image_knob(chain(levels={"image_tolerance": (0.3, 0.2, 0.1)}), "exact")
    assert seconds == pytest.approx([7 * 2.0 + 500 * 0.1, 7 * 1.0 + 500 * 0.2, 7 * 5.0 + 500 * 0.3])
    assert asked == [(("exact", 0.1), ("exact", 0.3)), (("exact", 0.1), ("exact", 0.2))]
    assert errors[0].tolist() == np.full((3, 2), 0.1).tolist()
    assert not errors[2].any()
    assert nodes.tolist() == [[3, 5, 4, 1], [2, 5, 4, 1], [1, 5, 4, 1]]


def test_the_pilot_s_truth_is_the_coarse_table_put_right_at_twelve_diameters(monkeypatch):
    d = np.linspace(0.1, 0.26, 321)
    coarse = 0.8 * np.exp(9j * d)
    ratio = (0.95 + 0.2 * d) * np.exp(1j * (3.0 + 4.0 * d))  # smooth: straight in level and phase between places
    asked = []

    def smooth(cell, light, ends, *, tolerance, engine):
        asked.append((cell, light.wavelength_um, ends, tolerance, engine))
        return lambda x: SimpleNamespace(
            t=np.interp(x, d, coarse.real * 0) + 0.8 * np.exp(9j * x) * (0.95 + 0.2 * x) * np.exp(1j * (3 + 4 * x))
        )

    monkeypatch.setattr(plan.engines, "smooth", smooth)
    monkeypatch.setattr(plan.engines, "choose", lambda cell: "modal")
    lens = SimpleNamespace(cell="cell", wavelength_um=0.85, proxy=SimpleNamespace(domain_um=(0.1, 0.26)))
    one = chain(lens=lens, table=lambda tolerance: coarse, library=lambda tolerance: (SimpleNamespace(solves=40), 1.0))
    one.aperture.diameter_um = d
    table, seconds = plan._exact(one)
    assert asked == [("cell", 0.85, (0.1, 0.26), 1e-4, "modal")]
    # the level's logarithm is straight between twelve diameters to (0.2 h)² / 8, h = 0.0145; steps of d: 5e-4 / 2 x 9
    assert np.abs(table / (coarse * ratio) - 1).max() < 3e-3
    assert seconds >= 0


def test_a_table_between_the_diameters_of_a_library():
    d, level, phase = np.array([0.1, 0.14, 0.3]), np.array([0.9, 0.7, 0.8]), np.array([2.0, 3.6, 5.9])
    t = np.zeros((2, 1, 1, 3), complex)
    off = 0.05 * np.exp(1j * np.array([0.3, -1.0, 2.0]))
    t[:, 0, 0] = level * np.exp(1j * phase) + off, level * np.exp(1j * phase) - off
    one = SimpleNamespace(
        library=lambda tolerance: (SimpleNamespace(t=t, diameter_um=d), 1.0),
        aperture=SimpleNamespace(diameter_um=np.array([0.11, 0.22])),
    )
    want = [0.85 * np.exp(2.4j), 0.75 * np.exp(4.75j)]
    assert plan.Chain.table(one, 1e-2) == pytest.approx(np.array(want), rel=1e-12)


def test_knobs_run_from_coarse_to_fine():
    for name, row in plan.LEVELS.items():
        rising = np.diff(row) > 0
        assert rising.all() if name.endswith("count") else not rising.any()
    decades = {"library_tolerance": (-1.5, -4), "psf_tolerance": (-1.5, -5), "kernel_tolerance": (-1, -4)}
    for name, (coarse, fine) in decades.items():  # 3 and 1 of each decade, or 1 alone
        logs = np.log10(plan.LEVELS[name])
        assert (logs[0], logs[-1]) == pytest.approx((coarse, fine), abs=0.03)  # lg 3 is 0.477
        assert np.abs(2 * logs - np.rint(2 * logs)).max() < 0.05
        assert np.diff(logs).min() > -1.01
    assert plan.LEVELS["diameter_step_nm"] == (20, 10, 5, 2, 1)
    assert plan.LEVELS["wavelength_count"] == (1, 2, 3, 4, 6, 8)
    assert plan.LEVELS["depth_count"] == (4, 6, 8, 12, 16, 24, 32, 48)
    for knob in ("depth_count", "wavelength_count", "psf_tolerance"):
        assert getattr(plan.PILOT, knob) in plan.LEVELS[knob]  # its seconds stand for a stack
    true = plan.TRUE_LEVELS
    assert {k: true[k] for k in ("library_tolerance", "diameter_step_nm")}.items() <= plan.LEVELS.items()
    assert all(np.diff(true["image_tolerance"]) < 0)
