"""Links of the error budget of a small lens: sums over its pillars, scaling laws, and
what the device itself says.
"""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from characterize.model import NAMES
from codesign.budget import links, task
from codesign.budget.links import FabricatedDevice
from codesign.optics import (
    ImageWindow,
    TabulatedLens,
    image_difference,
    pixel_kernels,
    psf_difference,
)
from metalens.cell import Incidence
from metalens.core.errors import LensError
from metalens.fabrication import Printed, Spread, State, draws, sensitivity
from metalens.pillars import PillarLibrary, Sweep, engines
from tests.codesign import made_lens
from tests.codesign.budget import small_bench as small

RNG = np.random.default_rng(31)
# the table of 8192 diameters, 2e-5 um apart: half of that at 55 rad a um, in every
# pillar anew
ROUNDING_RAD = 2e-3


def pillars_um(bench):
    """Diameters of the pillars that stand."""
    d = bench.lens.diameters.diameter_um
    return d[d > 0]


def places(bench):
    """(u, v) of the pillars that stand: x and y over the radius."""
    d = bench.lens.diameters
    u, v = np.meshgrid(d.x_um / d.radius_um, d.y_um / d.radius_um)
    return u[d.diameter_um > 0], v[d.diameter_um > 0]


def given(bench, **changed):
    """The bench with something else known beside the lens."""
    return replace(bench, given=replace(bench.given, **changed))


def of_wave(bench, wave):
    """(psf, gaze) errors of a lens plane, by the device and the estimator alone."""
    optics = bench.device.image(wave=wave)
    return errors(bench, optics)


def errors(bench, optics):
    """(psf, gaze) errors of an image against that of the bench, by its stack and by the
    pull of its estimator.
    """
    change = task.expected_electrons(
        bench.eyes.anchor, optics, bench.setting
    ) - task.expected_electrons(bench.eyes.anchor, bench.device.whole, bench.setting)
    shift = np.einsum("skp,sp->sk", bench.reader.pull.numpy(), change.numpy())
    return image_difference(optics, bench.device.whole), np.hypot(
        shift[:, 0], shift[:, 1]
    ).mean()


def test_a_rounded_mask_turns_every_pillar_by_its_own_rounding():
    """The lens drawn anew with diameters that are whole steps of 4 nm, at 55 rad a um;
    without a mask no entry.

    Diameters as the table knows them: 32 of 19 856 lie so near half a step that it
    takes them the other way.
    """
    bench = small.bare()
    (got,) = links.mask_entry(bench)
    d, table = bench.lens.diameters.diameter_um, bench.aperture
    rounded = np.where(
        d > 0, np.rint(table.diameter_um[table.place] / 4e-3) * 4e-3, 0.0
    )
    turn = small.SLOPE * (rounded - d)[d > 0]
    assert got.phase_rad == pytest.approx(np.std(turn), abs=ROUNDING_RAD)
    other = replace(
        bench.lens, diameters=replace(bench.lens.diameters, diameter_um=rounded)
    )
    aperture = TabulatedLens(other)
    psf, gaze = of_wave(
        bench, bench.gathered(*aperture.maps(aperture.designed()), lens=other)
    )
    assert got.psf == pytest.approx(psf, rel=0.05)  # both tables round by 1 mrad of 64
    assert got.gaze_rad == pytest.approx(gaze, rel=0.05)
    assert "4 nm" in got.method
    assert not list(links.mask_entry(given(bench, mask=None)))


@functools.cache
def solved():
    """Twelve diameters from the thinnest pillar to the widest, and t there by coupled
    waves: the budget asks the modal
    solver."""
    lens, d = small.lens(), pillars_um(small.bare())
    solve = engines.solve_to_tolerance(
        lens.cell, Incidence(lens.wavelength_um), tolerance=4e-3, engine="rcwa"
    )
    at = np.linspace(d.min(), d.max(), 12)
    return at, np.array([solve(float(one)).t for one in at])


def library_of(t):
    """A library of these entries at the design wavelength, both polarisations apart; of
    nothing at two others.
    """
    at, _ = solved()
    both = np.stack([t + 0.03j, t - 0.03j])
    entries = np.stack([np.ones_like(both), both, 1j * np.ones_like(both)], 1)[:, None]
    none = np.zeros(entries.shape)
    return PillarLibrary(
        small.CELL, Sweep((0.80, 0.85, 0.88), tolerance=6e-3), ("s", "p"), np.zeros(1), np.array([0.80, 0.846, 0.88]),
        at, entries, 0 * entries, none, none, np.empty((0, 5)), "modal", 12, small.PROXY,
    )  # fmt: skip


def test_a_library_errs_by_what_is_wrong_with_it_and_the_proxy_by_what_it_leaves_of_it():
    """Entries turned by 0.1 and 9 rad a um: over the pillars the scatter of 9 D. And a
    proxy that a library follows but
    for a factor: the scatter of the factor, its amplitude in the image alone."""
    bench = small.bare()
    d, (at, t) = pillars_um(bench), solved()
    solver, _ = links.solver_entries(
        given(bench, library=library_of(t * np.exp(1j * (0.1 + 9 * at))))
    )
    assert solver.link == "pillar solver"
    assert solver.phase_rad == pytest.approx(
        np.std(9 * d), abs=6e-3
    )  # two solvers, of 4e-3 and 2e-4
    assert "2e-04, 12 diameters" in solver.method  # 6e-3 of the library over thirty
    proxy_t = small.PROXY.transmission(at, 0.85) * np.exp(
        1j * small.PROXY.phase_rad(at, 0.85)
    )
    factor = (1.2 - at) * np.exp(1j * (4.0 - 7 * at))
    _, proxy = links.solver_entries(given(bench, library=library_of(proxy_t * factor)))
    assert proxy.phase_rad == pytest.approx(np.std(7 * d), abs=ROUNDING_RAD)
    aperture = bench.aperture
    turned = (
        aperture.designed()
        * (1.2 - aperture.diameter_um)
        * np.exp(-7j * aperture.diameter_um)
    )
    psf, gaze = of_wave(bench, bench.gathered(*aperture.maps(turned)))
    assert (proxy.psf, proxy.gaze_rad) == (
        pytest.approx(psf, rel=1e-3),
        pytest.approx(gaze, rel=1e-3),
    )


def test_without_a_library_solver_and_proxy_err_together():
    """The exact pillars against the straight line that the lens was made with, at every
    pillar by its own diameter.
    """
    bench, (at, t) = given(small.bare(), tolerance=3e-3), solved()
    (got,) = links.solver_entries(bench)
    assert got.link == "pillar solver and proxy"
    assert "1e-04, 12 diameters" in got.method
    d = pillars_um(bench)
    turn = np.interp(d, at, np.unwrap(np.angle(t))) - small.SLOPE * d
    mean = np.angle(np.exp(1j * turn).mean())
    off = np.angle(np.exp(1j * (turn - mean)))
    assert got.phase_rad == pytest.approx(
        np.sqrt((off**2).mean()), rel=0.01
    )  # nowhere near the cut of a turn
    assert got.psf > 0.1


def sines(bench):
    """By which the lens turns light at every pillar that stands, from 3 mm to 0.3 mm."""
    d = bench.lens.diameters
    r = np.hypot(*(v * d.radius_um for v in places(bench)))
    return r / np.hypot(r, 300.0) + r / np.hypot(r, 3000.0)


def test_rows_of_unlike_pillars_turn_the_pillars_by_the_sine_there():
    bench = small.bare()
    got = links.other_rows_entry(bench, small.ROWS, "rows")
    turn = np.angle(small.ROWS.mean(sines(bench)))
    assert got.phase_rad == pytest.approx(np.std(turn), rel=1e-6)
    assert got.phase_rad > 0.02
    holding = replace(bench.lens, neighbours=small.ROWS)
    aperture = TabulatedLens(holding)
    psf, gaze = of_wave(
        bench, bench.gathered(*aperture.maps(aperture.designed()), lens=holding)
    )
    assert (got.psf, got.gaze_rad) == (
        pytest.approx(psf, rel=1e-6),
        pytest.approx(gaze, rel=1e-6),
    )
    # 0.85 um turned by 0.05 and 0.11 over pillars 0.3 um apart: 56.7 and 25.8 of them;
    # the diagonal is not told
    assert links.row_lengths(small.ROWS, 0.3) == [57, 26]


def test_what_is_open_of_rows_that_the_lens_holds_adds_in_quadrature():
    """Another truncation, a row left out, zones that get shorter: each by its own turn
    against the rows held.
    """
    bench = small.filmed()
    (got,) = links.neighbour_coupling_entry(bench)
    s, rows = sines(bench), small.ROWS
    others = rows.doubted(s)
    apart = [
        np.std(np.angle(other.mean(s)) - np.angle(rows.mean(s))) for other in others
    ]
    assert got.phase_rad == pytest.approx(
        math.sqrt(sum(v * v for v in apart)), rel=1e-5
    )
    alone = [links.other_rows_entry(bench, other, "") for other in others]
    assert min(one.psf for one in alone) > 0
    assert got.psf == pytest.approx(math.hypot(*(one.psf for one in alone)), rel=1e-6)
    assert got.gaze_rad == pytest.approx(
        math.hypot(*(one.gaze_rad for one in alone)), rel=1e-6
    )
    assert "lens file" in got.method


def test_rows_of_tilted_walls_are_not_solved():
    bench = small.bare()
    tilted = replace(
        bench, lens=replace(bench.lens, cell=replace(small.CELL, sidewall_rad=0.05))
    )
    assert not list(links.neighbour_coupling_entry(tilted))


WIDER = {"bias_nm": 1.7, "bias_x_nm": 0.9, "bias_y_nm": -1.4, "bias_r_nm": 1.1}
BENT = {"coma_x_rad": 0.04, "coma_y_rad": -0.07}


@pytest.mark.parametrize("causes", [WIDER, WIDER | BENT])
def test_a_made_lens_turns_its_pillars_by_their_bias_and_its_wave_front_by_its_bend(
    causes,
):
    bench, made = small.bare(), State.of(causes)
    u, v = places(bench)
    turn = small.SLOPE * made.bias_um(u, v) + made.phase_rad(u, v)
    got = links.rms_over_lenses(bench, "made", [FabricatedDevice(made)], "so")
    assert got.phase_rad == pytest.approx(np.std(turn), abs=ROUNDING_RAD / 2)
    assert got.phase_rad > 10 * ROUNDING_RAD
    d = bench.lens.diameters
    u, v = np.meshgrid(d.x_um / d.radius_um, d.y_um / d.radius_um)
    wider = np.where(d.diameter_um > 0, d.diameter_um + made.bias_um(u, v), 0.0)
    aperture = TabulatedLens(
        replace(bench.lens, diameters=replace(d, diameter_um=wider))
    )
    phase, level = aperture.maps(aperture.designed())
    wave = bench.gathered(
        phase + torch.from_numpy(made.phase_rad(u, v).astype(np.float32)), level
    )
    psf, gaze = of_wave(bench, wave)
    assert (got.psf, got.gaze_rad) == (
        pytest.approx(psf, rel=0.02),
        pytest.approx(gaze, rel=0.03),
    )  # 1 mrad of 80


def test_a_sensor_that_is_off_is_told_by_the_device_and_lenses_count_by_their_root_mean_square():
    bench = small.bare()
    moved = FabricatedDevice(State.of(), -7.0)
    far = links.rms_over_lenses(bench, "made", [moved], "so")
    assert far.phase_rad == pytest.approx(0, abs=1e-6)
    psf, gaze = errors(bench, bench.device.image(shift_um=-7.0))
    assert (far.psf, far.gaze_rad) == (
        pytest.approx(psf, rel=1e-4),
        pytest.approx(gaze, rel=1e-3),
    )
    wide = FabricatedDevice(State.of(WIDER))
    near = links.rms_over_lenses(bench, "made", [wide], "so")
    both = links.rms_over_lenses(bench, "made", [moved, wide], "so")
    for name in ("phase_rad", "psf", "gaze_rad"):
        one, other = getattr(far, name), getattr(near, name)
        assert getattr(both, name) == pytest.approx(
            math.sqrt((one**2 + other**2) / 2), rel=1e-6
        )


def test_a_process_is_drawn_as_often_as_asked_and_doubles_with_its_spread():
    """Biases alone: the pillars turn by 55 rad a um of those drawn; without a mask
    nothing is drawn.
    """
    bench = small.bare()
    (got,) = links.process_entries(bench)
    u, v = places(bench)
    biases = [
        draw.state().bias_um(u, v) for draw in draws(bench.given.mask.spread, 3, seed=5)
    ]
    assert got.phase_rad == pytest.approx(
        small.SLOPE * math.sqrt(np.mean([np.var(b) for b in biases])), rel=0.05
    )
    twice = Spread.only(
        **{name: 2 * value for name, value in bench.given.mask.spread.values().items()}
    )
    (more,) = links.process_entries(given(bench, mask=Printed(spread=twice)))
    assert more.phase_rad == pytest.approx(2 * got.phase_rad, rel=0.03)
    assert more.gaze_rad == pytest.approx(
        2 * got.gaze_rad, rel=0.1
    )  # to first order in 0.03 rad
    assert got.method.startswith("3 draws")
    assert not list(links.process_entries(given(bench, mask=None)))


def fit_of(lens, sigma):
    """A fit of this lens that found much, known to ``sigma``: nothing but what is open
    counts.
    """
    fitted = replace(made_lens.asbuilt(), design=lens, response=sensitivity(lens))
    return replace(
        fitted,
        covariance=np.diag(
            np.array([sigma.get(name, 0.0) for name in fitted.names]) ** 2.0
        ),
    )


def test_a_fit_leaves_open_what_its_draws_scatter_about_the_best_estimate():
    bench = small.bare()
    (none,) = links.calibration_entry(given(bench, asbuilt=fit_of(bench.lens, {})))
    assert (none.phase_rad, none.psf) == pytest.approx((0, 0), abs=1e-6)
    one, two = (
        next(
            links.calibration_entry(
                given(bench, asbuilt=fit_of(bench.lens, {"bias_x_nm": s}), draws=2)
            )
        )
        for s in (0.8, 1.6)
    )
    fitted = fit_of(bench.lens, {"bias_x_nm": 0.8})
    column = list(NAMES).index("bias_x_nm")
    off = [
        fitted.parameters(row)[column] - fitted.parameters()[column]
        for row in fitted.lens_samples(2, seed=3)
    ]
    u, v = places(bench)
    turn = [
        small.SLOPE * State.of({"bias_x_nm": 1.0}).bias_um(u, v) * amount
        for amount in off
    ]
    assert one.phase_rad == pytest.approx(
        math.sqrt(np.mean([np.var(t) for t in turn])), rel=0.05
    )
    assert two.gaze_rad == pytest.approx(2 * one.gaze_rad, rel=0.1)
    assert one.method.startswith("2 draws")
    (shifted,) = links.calibration_entry(
        given(bench, asbuilt=fit_of(bench.lens, {"distance_um": 2.5}), draws=1)
    )
    place = list(NAMES).index("distance_um")
    fitted = fit_of(bench.lens, {"distance_um": 2.5})
    (row,) = fitted.lens_samples(1, seed=3)
    psf, _ = errors(
        bench,
        bench.device.image(
            shift_um=float(fitted.parameters(row)[place] - fitted.parameters()[place])
        ),
    )
    assert shifted.psf == pytest.approx(psf, rel=1e-3)
    assert not list(links.calibration_entry(bench))


@pytest.mark.parametrize(
    ("off_um", "size", "refused"),
    [(8e-7, 160, False), (1.2e-5, 160, True), (0.0, 158, True)],
)
def test_a_fit_of_another_lens_is_refused(off_um, size, refused):
    """Diameters are told apart by a picometre and 1e-5 of themselves."""
    bench = small.bare()
    d = bench.lens.diameters
    other = d.diameter_um[:size, :size].copy()
    other[80, 71] += off_um
    its = replace(d, diameter_um=other)
    fitted = replace(fit_of(bench.lens, {}), design=replace(bench.lens, diameters=its))
    told = links.calibration_entry(given(bench, asbuilt=fitted, draws=1))
    if refused:
        with pytest.raises(LensError, match="another lens"):
            list(told)
    else:
        assert len(list(told)) == 1


NARROW = 41.0  # um: width of the kernels


@pytest.mark.parametrize("make", [small.bare, small.filmed])
def test_numerics_err_each_by_its_own_setting(make):
    """At the finest setting of all nothing errs; where one is coarser, its link alone
    does, as its kernels say.
    """
    bench = make()
    setting = replace(
        bench.finest,
        depth_count=4,
        wavelength_count=min(bench.finest.wavelength_count, 2),
    )
    window = ImageWindow(
        bench.window.near_um, bench.window.far_um, bench.window.pitch_um, NARROW
    )
    bench = replace(given(bench, numerics=setting), finest=setting, window=window)
    names = ["propagation", "depth sampling", "wavelength sampling", "image kernels"]
    if not bench.given.fwhm_nm:
        names.remove("wavelength sampling")
    rows = list(links.numerics_entries(bench))
    assert [row.link for row in rows] == names
    assert all((row.psf, row.gaze_rad) == (0, 0) for row in rows)
    coarser = [{"psf_tolerance": 3e-2}, {"depth_count": 2}, {"basis_tolerance": 0.2}]
    if bench.given.fwhm_nm:
        coarser.insert(2, {"wavelength_count": 1})
    maps = bench.aperture.maps(bench.aperture.designed())
    finest = pixel_kernels(
        bench.lens, maps, setting, window, fwhm_nm=bench.given.fwhm_nm
    )
    for name, change in zip(names, coarser, strict=True):
        rows = list(
            links.numerics_entries(given(bench, numerics=replace(setting, **change)))
        )
        other = pixel_kernels(
            bench.lens,
            maps,
            replace(setting, **change),
            window,
            fwhm_nm=bench.given.fwhm_nm,
        )
        images = [
            task.expected_electrons(bench.eyes.anchor, o, bench.setting)
            for o in (other, finest)
        ]
        gaze = task.gaze_mean(
            bench.reader.shift(images[0]) - bench.reader.shift(images[1])
        )
        for row in rows:
            want = (
                (psf_difference(other, finest, window), gaze)
                if row.link == name
                else (0, 0)
            )
            assert (row.psf, row.gaze_rad) == pytest.approx(want, rel=1e-6)


@pytest.mark.parametrize("make", [small.bare, small.filmed])
def test_without_a_run_the_answer_errs_by_noise_and_what_the_estimator_knows_is_not_counted(
    make,
):
    """Of a Gaussian of sigma in each angle the rms is sigma sqrt(2), the mean sigma
    sqrt(pi / 2).
    """
    bench = make()
    rows = {row.link: row for row in links.oracle_answer_entry(bench)}
    sigma = np.sqrt(
        [np.trace(c) / 2 for c in bench.reader.covariance[:, :2, :2].numpy()]
    )
    noise = sigma[:, None, None] * RNG.standard_normal((1, 10**6, 2))
    rms = np.sqrt((noise**2).sum(-1).mean())
    assert bench.reader.noise_rad == pytest.approx(rms, rel=3e-3)
    plane = np.hypot(*(rms / math.sqrt(2) * RNG.standard_normal((2, 10**6))))
    assert rows["sensor noise"].gaze_rad == pytest.approx(plane.mean(), rel=3e-3)
    assert rows["sensor noise"].counted
    assert math.isnan(rows["reader"].gaze_rad)
    here = bench.device
    optics = {"field": here.one_psf(), "radiometry": here.evenly_lit()}
    if bench.given.fwhm_nm:
        optics["spectrum"] = here.one_wavelength(0.85)
    else:
        assert (
            rows["spectrum"].psf,
            rows["spectrum"].gaze_rad,
            rows["spectrum"].counted,
        ) == (0, 0, True)
    for link, seen in optics.items():
        assert (rows[link].psf, rows[link].gaze_rad) == pytest.approx(
            errors(bench, seen), rel=1e-6, abs=1e-12
        )
        assert not rows[link].counted
        assert rows[link].gaze_rad > 0


def test_films_are_taken_away_on_both_faces_and_a_lens_without_them_errs_by_none():
    bench = small.filmed()
    rows = {row.link: row for row in links.pillar_device_entry(bench)}
    layers = replace(bench.lens.layers, front=(), behind=())
    assert rows["glass"].psf == pytest.approx(
        errors(bench, bench.device.image(layers=layers))[0], rel=1e-6
    )
    one_face = replace(bench.lens.layers, front=())
    assert (
        rows["glass"].psf > 1.02 * errors(bench, bench.device.image(layers=one_face))[0]
    )
    assert "2 films" in rows["glass"].method
    assert 1e-8 < rows["polarisation"].psf < 1e-3  # NA 0.08
    assert set(rows) == {
        "glass",
        "polarisation",
    }  # no run: nothing smooth to compare with
    bare = {row.link: row for row in links.pillar_device_entry(small.bare())}["glass"]
    assert (bare.psf, bare.gaze_rad) == (0.0, 0.0)


def test_nothing_is_measured_without_a_run():
    assert not list(links.measured_entry(small.bare()))
