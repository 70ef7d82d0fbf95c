"""The settings that links are compared with, and how far the lens of a reader may be off, at the very edges."""

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
def test_the_finest_is_twice_the_depths_and_a_tenth_of_the_tolerances_or_less(numerics, fwhm_nm, finest):
    made = finest_of(numerics, fwhm_nm=fwhm_nm)
    assert (made.depth_count, made.wavelength_count) == (finest.depth_count, finest.wavelength_count)
    assert (made.psf_tolerance, made.basis_tolerance) == pytest.approx(
        (finest.psf_tolerance, finest.basis_tolerance), rel=1e-12
    )


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize(("share", "same"), [(1.0199, True), (0.9801, True), (1.0201, False), (0.9799, False)])
def test_lenses_agree_to_two_percent_of_the_readers(place, share, same):
    mine = [2.5, 850.0, 1.25]
    mine[place] *= share
    if same:
        same_geometry(tuple(mine), HERS, "here")
    else:
        with pytest.raises(LensError, match=r"are 2\.5 mm, 850 nm, 1\.25 mm there and .* mm in here"):
            same_geometry(tuple(mine), HERS, "here")


@pytest.mark.parametrize(
    ("off", "same"), [({}, True), ({"radius": 0.9}, False), ({"wave": 1.03}, False), ({"far": 1.05}, False)]
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
        with pytest.raises(LensError, match=r"the lens file; give the lens\.h5 of the run"):
            same_lens(lens, HERS)


def bench(reading):
    rest = dict.fromkeys(prepared.Bench.__dataclass_fields__)
    device = SimpleNamespace(whole="whole", above="pillars", window_um=77.0)
    return prepared.Bench(**rest | {"device": device, "lens": "lens", "reading": reading})


def test_an_entry_is_the_change_of_the_images_and_of_the_gaze_that_is_read(monkeypatch):
    made = bench(None)
    monkeypatch.setattr(prepared, "image_difference", lambda one, other: {("new", "whole"): 0.31}[one, other])
    monkeypatch.setattr(prepared.Bench, "shift", lambda self, one, other: (one, other))
    monkeypatch.setattr(prepared.task, "gaze_mean", lambda shift: {("new", "whole"): 0.027}[shift])
    entry = made.entry("link", "new", "so", phase_rad=0.4)
    assert (entry.link, entry.phase_rad, entry.psf, entry.gaze_rad, entry.method) == ("link", 0.4, 0.31, 0.027, "so")
    assert made.above == ["pillars"]
    changed = SimpleNamespace(
        changed=lambda *about, phase_rad: (*about, phase_rad), true=SimpleNamespace(above="phase")
    )
    assert bench(changed).entry("link", "new", "so", phase_rad=0.4) == ("link", "new", "whole", "so", 0.4)
    assert bench(changed).above == ["pillars", "phase"]


def test_pillars_are_gathered_over_the_window_of_the_device_on_the_lens_unless_another_is_given(monkeypatch):
    monkeypatch.setattr(prepared, "gathered", lambda lens, phase, level, *, window_um: (lens, phase, level, window_um))
    assert bench(None).gathered("phase", "level") == ("lens", "phase", "level", 77.0)
    assert bench(None).gathered("phase", "level", lens="other") == ("other", "phase", "level", 77.0)


def test_what_is_known_where_nothing_is_said():
    given = Given()
    assert (given.fwhm_nm, given.draws, given.tolerance) == (0.0, 4, 1e-3)
    assert given.frames.subjects == 5
