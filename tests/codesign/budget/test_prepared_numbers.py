"""The settings that links are compared with, and how far the lens of a reader may be
off, at the very edges.
"""

from types import SimpleNamespace

import pytest

from codesign.budget import prepared
from codesign.budget.prepared import Given, finest_of, same_geometry, same_lens
from codesign.optics import Numerics
from metalens.ground.errors import LensError

HERS = SimpleNamespace(sensor_distance_mm=2.5, wavelength_nm=850.0, aperture_mm=1.25)


@pytest.mark.parametrize(
    ("numerics", "fwhm_nm", "finest"),
    [
        (Numerics(13, 3, 3e-3, 5e-2), 37.0, Numerics(26, 9, 1e-5, 1e-4)),
        (Numerics(13, 3, 3e-3, 5e-2), 0.0, Numerics(26, 1, 1e-5, 1e-4)),
        (Numerics(31, 2, 7e-5, 7e-4), 37.0, Numerics(62, 8, 7e-6, 7e-5)),
        (Numerics(33, 2, 3e-4, 3e-3), 37.0, Numerics(64, 8, 1e-5, 1e-4)),
        (Numerics(40, 1, 2e-6, 2e-5), 0.0, Numerics(64, 1, 2e-7, 2e-6)),
    ],
)
def test_the_finest_is_twice_the_depths_and_a_tenth_of_the_tolerances_or_less(
    numerics, fwhm_nm, finest
):
    made = finest_of(numerics, fwhm_nm=fwhm_nm)
    assert (made.depth_count, made.wavelength_count) == (
        finest.depth_count,
        finest.wavelength_count,
    )
    assert (made.psf_tolerance, made.basis_tolerance) == pytest.approx(
        (finest.psf_tolerance, finest.basis_tolerance), rel=1e-12
    )


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize(
    ("share", "same"),
    [(1.0199, True), (0.9801, True), (1.0201, False), (0.9799, False)],
)
def test_lenses_agree_to_two_percent_of_the_readers(place, share, same):
    mine = [2.5, 850.0, 1.25]
    mine[place] *= share
    if same:
        same_geometry(tuple(mine), HERS, "here")
    else:
        with pytest.raises(
            LensError, match=r"are 2\.5 mm, 850 nm, 1\.25 mm there and .* mm in here"
        ):
            same_geometry(tuple(mine), HERS, "here")


@pytest.mark.parametrize(
    ("off", "same"),
    [
        ({}, True),
        ({"radius": 0.9}, False),
        ({"wave": 1.03}, False),
        ({"far": 1.05}, False),
    ],
)
def test_a_lens_file_is_compared_in_mm_nm_and_by_its_diameter(off, same):
    """2500 um, 0.85 um, and a radius of 625 um."""
    lens = SimpleNamespace(
        sensor_distance_um=2500.0 * off.get("far", 1), wavelength_um=0.85 * off.get("wave", 1),
        diameters=SimpleNamespace(radius_um=625.0 * off.get("radius", 1)),
    )  # fmt: skip
    if same:
        same_lens(lens, HERS)
    else:
        with pytest.raises(
            LensError, match=r"the lens file; give the lens\.h5 of the run"
        ):
            same_lens(lens, HERS)


def bench(reading):
    rest = dict.fromkeys(prepared.Bench.__dataclass_fields__)
    device = SimpleNamespace(whole="whole", above="pillars", window_um=77.0)
    return prepared.Bench(
        **rest | {"device": device, "lens": "lens", "reading": reading}
    )


def test_an_entry_is_the_change_of_the_images_and_of_the_gaze_that_is_read(monkeypatch):
    made = bench(None)
    monkeypatch.setattr(
        prepared,
        "image_difference",
        lambda one, other: {("new", "whole"): 0.31}[one, other],
    )
    monkeypatch.setattr(prepared.Bench, "shift", lambda self, one, other: (one, other))
    monkeypatch.setattr(
        prepared.task, "gaze_mean", lambda shift: {("new", "whole"): 0.027}[shift]
    )
    entry = made.entry("link", "new", "so", phase_rad=0.4)
    assert (entry.link, entry.phase_rad, entry.psf, entry.gaze_rad, entry.method) == (
        "link",
        0.4,
        0.31,
        0.027,
        "so",
    )
    assert made.above == ["pillars"]
    changed = SimpleNamespace(
        changed=lambda *about, phase_rad: (*about, phase_rad),
        true=SimpleNamespace(above="phase"),
    )
    assert bench(changed).entry("link", "new", "so", phase_rad=0.4) == (
        "link",
        "new",
        "whole",
        "so",
        0.4,
    )
    assert bench(changed).above == ["pillars", "phase"]


def test_pillars_are_gathered_over_the_window_of_the_device_on_the_lens_unless_another_is_given(
    monkeypatch,
):
    monkeypatch.setattr(
        prepared,
        "gathered",
        lambda lens, phase, level, *, window_um: (lens, phase, level, window_um),
    )
    assert bench(None).gathered("phase", "level") == ("lens", "phase", "level", 77.0)
    assert bench(None).gathered("phase", "level", lens="other") == (
        "other",
        "phase",
        "level",
        77.0,
    )


def test_what_is_known_where_nothing_is_said():
    given = Given()
    assert (given.fwhm_nm, given.draws, given.tolerance) == (0.0, 4, 1e-3)
    assert given.frames.subjects == 5


def prepared_with(monkeypatch, given, reading=None):
    """What a bench of a lens of 0.8 um is made of, by names; the grid of its device and
    the window of its cells.
    """
    asked = {}

    def gathered(lens, phase, level, *, window_um):
        asked["window_um"] = window_um
        return "wave"

    def device(wave, grid, *, layers, distance_um, spectrum):
        asked.update(grid=grid, spectrum=spectrum, distance_um=distance_um)
        return SimpleNamespace(whole="whole")

    aperture = SimpleNamespace(
        maps=lambda table: (table, "level"), designed=lambda: "designed"
    )
    eyes = SimpleNamespace(depths_um=(15_000.0, 28_000.0))
    monkeypatch.setattr(prepared, "Aperture", lambda lens: aperture)
    monkeypatch.setattr(
        prepared.task, "views", lambda setting: asked.update(setting=setting) or eyes
    )
    monkeypatch.setattr(prepared.task, "linear", lambda eyes, optics, setting: optics)
    monkeypatch.setattr(prepared, "gathered", gathered)
    monkeypatch.setattr(prepared, "device", device)
    monkeypatch.setattr(
        prepared, "same_lens", lambda lens, optics: asked.update(same=optics)
    )
    monkeypatch.setattr(prepared, "Reading", lambda run, frames, *, fwhm_nm: reading)
    monkeypatch.setattr(
        prepared,
        "kernels",
        lambda lens, maps, finest, window, *, fwhm_nm: f"kernels of {fwhm_nm:g} nm",
    )
    lens = SimpleNamespace(
        reduced_um=2_121.0,
        wavelength_um=0.8,
        sensor_distance_um=2_300.0,
        layers="films",
    )
    made = prepared.bench(
        lens, given, prepared.TaskSetting(scenes=2, pixels=29, margin=6, pitch_um=4.7)
    )
    return made, asked


@pytest.mark.parametrize("fwhm_nm", [0.0, 37.0])
def test_a_bench_without_a_run_images_its_eyes_with_windows_of_their_margin(
    monkeypatch, fwhm_nm
):
    """Twice 6 samples and one of 4.7 um are 61.1 um."""
    made, asked = prepared_with(monkeypatch, Given(fwhm_nm=fwhm_nm))
    grid = asked["grid"]
    assert (grid.samples, grid.margin, grid.window) == ((29, 29), 6, 13)
    assert asked["window_um"] == pytest.approx(61.1, rel=1e-12)
    assert asked["distance_um"] == 2_300.0
    assert asked["setting"].sensor_distance_um == 2_121.0
    assert (made.window.near_um, made.window.far_um, made.window.pitch_um) == (
        15_000.0,
        28_000.0,
        4.7,
    )
    assert made.reader == "whole"
    assert made.reading is None
    if fwhm_nm:
        assert (asked["spectrum"].peak_nm, asked["spectrum"].fwhm_nm) == (
            pytest.approx(800.0),
            37.0,
        )
    else:
        assert asked["spectrum"] is None


def test_a_bench_with_a_run_stands_on_its_frames_and_its_estimator_knows_one_psf(
    monkeypatch,
):
    about = []
    reading = SimpleNamespace(
        true=SimpleNamespace(window_um=88.0),
        stands=lambda *stood: about.append(stood) or SimpleNamespace(whole="seen"),
    )
    run = SimpleNamespace(settings=SimpleNamespace(optics="optics"))
    made, asked = prepared_with(monkeypatch, Given(run=run, fwhm_nm=37.0), reading)
    assert about == [("wave", "films", 2_300.0)]
    assert (asked["window_um"], asked["same"]) == (88.0, "optics")
    assert (made.reader, made.reading, made.device.whole) == (
        "kernels of 37 nm",
        reading,
        "seen",
    )
