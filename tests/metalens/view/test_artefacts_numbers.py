"""Panels of small artefacts whose arrays are typed in: scales, axes, orders and words,
number by number.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens import lens as lenses
from metalens import psf
from metalens.cell import Cell, Index
from metalens.ground import store
from metalens.ground.errors import StoreError
from metalens.lens import DiameterMap, Lens
from metalens.pillars import Proxy
from metalens.psf import Budget, PsfStack
from metalens.view import artefacts

RNG = np.random.default_rng(4)


def stack(light=None, **more):
    light = RNG.uniform(1, 2, (2, 3, 4, 5)) if light is None else light
    lead = light.shape[:-2]
    energy = np.arange(7.0, 7 + np.prod(lead)).reshape(lead)
    about = {
        "depths_um": np.array([700.0, 900.0, 1400.0]),
        "angles_rad": np.radians([[1.0, -2.0], [3.5, 0.0]]),
    }
    about |= {
        "wavelengths_um": np.array([0.83]),
        "weights": np.ones(1),
        "step_um": 0.8,
        "tolerance": 2e-4,
    }
    about |= {
        "centres_um": np.zeros((2, 2)),
        "sensor_distance_um": 123.0,
        "error": 3e-5,
        "reason": "by hand",
    }
    return PsfStack(light, energy, **(about | more))


def saved(path, made):
    psf.save(path, made)
    return path


def test_psfs_are_shares_of_the_highest_peak_with_an_angle_and_a_depth(tmp_path):
    made = stack(
        budget=Budget(3e-5, sampling=2e-5, polarisation=math.nan, outside=0.25)
    )
    images, curves, numbers = artefacts.psf_panels(saved(tmp_path / "one.h5", made))
    peak = made.intensity.max()
    assert images.values == pytest.approx(made.intensity / peak, rel=1e-12)
    assert images.step_um == 0.8
    assert images.optics
    assert [(a.name, a.unit) for a in images.axes] == [
        ("field angle", ""),
        ("depth", "mm"),
    ]
    assert list(images.axes[0].values) == ["1, -2 deg", "3.5, 0 deg"]
    assert images.axes[1].values == pytest.approx([0.7, 0.9, 1.4])
    brightest = np.unravel_index(made.intensity.argmax(), made.intensity.shape)
    assert [a.first for a in images.axes] == list(brightest[:2])
    assert (
        images.caption == "Samples of 0.8 um; stated relative error 3.0e-05 (by hand)."
    )
    assert curves.x == pytest.approx([0.7, 0.9, 1.4])
    assert curves.lines["peak"] == pytest.approx(made.intensity.max((2, 3)) / peak)
    assert curves.lines["light in the window"] == pytest.approx(made.energy_um2 / 12.0)
    assert [a.name for a in curves.axes] == ["field angle"]
    rows = {row[0]: row[1] for row in numbers.rows}
    assert (
        rows["numerical"],
        rows["sampling"],
        rows["polarisation"],
        rows["outside"],
    ) == (3e-5, 2e-5, "–", 0.25)
    assert numbers.head == ("cause", "error")


def test_a_batch_of_lenses_has_a_slider_of_its_own_and_one_angle_none(tmp_path):
    light = RNG.uniform(1, 2, (6, 2, 3, 4, 5))
    images, *_ = artefacts.psf_panels(saved(tmp_path / "many.h5", stack(light)))
    assert [(a.name, list(a.values)) for a in images.axes[:1]] == [
        ("lens", [0, 1, 2, 3, 4, 5])
    ]
    assert [a.name for a in images.axes] == ["lens", "field angle", "depth"]
    single = stack(
        light[0, 0], angles_rad=np.zeros((1, 2)), centres_um=np.zeros((1, 2))
    )
    images, curves, _ = artefacts.psf_panels(saved(tmp_path / "single.h5", single))
    assert [a.name for a in images.axes] == ["depth"]
    assert list(curves.axes) == []


def test_lights_of_one_lens_have_a_slider_and_the_worst_error_is_stated(tmp_path):
    first, second = stack(), stack(error=4e-3, reason="worse", wavelengths_um=np.array([0.8456, 0.95]),
                                   weights=np.array([0.5, 0.5]))  # fmt: skip
    saved(tmp_path / "a.h5", first)
    saved(tmp_path / "b.h5", second)
    images, _, numbers = artefacts.lights_panels(tmp_path)
    assert list(images.axes[0].values) == ["a, 830 nm", "b, 845.6 to 950 nm"]
    peak = max(first.intensity.max(), second.intensity.max())
    assert images.values == pytest.approx(
        np.stack([first.intensity, second.intensity]) / peak
    )
    assert "stated relative error 4.0e-03 (worse)" in images.caption
    assert numbers.head == ("cause", "a, 830 nm", "b, 845.6 to 950 nm")
    for change in (
        {"step_um": 0.9},
        {"depths_um": np.array([700.0, 900.0, 1401.0])},
        {"angles_rad": np.zeros((2, 2))},
    ):
        saved(tmp_path / "c.h5", dataclasses.replace(first, **change))
        with pytest.raises(
            StoreError, match=f"has other {next(iter(change))} than a.h5"
        ):
            artefacts.lights_panels(tmp_path)
    saved(
        tmp_path / "c.h5",
        dataclasses.replace(first, intensity=first.intensity[..., :4]),
    )
    with pytest.raises(StoreError, match="has other samples"):
        artefacts.lights_panels(tmp_path)


def test_a_lens_has_its_sizes_in_nanometres_with_phase_and_level_of_each(tmp_path):
    """phase 2 pi (0.4 + 3 D), |T| 0.83; the middle row of three, from pillar to pillar."""
    low, high = 0.08, 0.24
    middle, half = (low + high) / 2, (high - low) / 2
    coefficients = 2 * math.pi * np.array([[0.4 + 3 * middle, 3 * half]])
    proxy = Proxy(
        coefficients, np.array([[0.83, 0.0]]), (low, high), (0.85, 0.85), 0.0, 0.0
    )
    sizes = np.array(
        [[0.0, 0.1, 0.0, 0.1], [0.15, 0.0, 0.2, 0.1], [0.0, 0.2, 0.1, 0.0]]
    )
    made = Lens(
        DiameterMap(sizes, 0.3),
        Cell(0.3, 0.7, Index(3.6)),
        proxy,
        0.85,
        30.0,
        math.inf,
        "map",
    )
    lenses.save(tmp_path / "lens.h5", made)
    pillars, section = artefacts.lens_panels(tmp_path / "lens.h5")
    assert pillars.sizes == pytest.approx([100, 150, 200])
    assert pillars.index.tolist() == [[0, 1, 0, 1], [2, 0, 3, 1], [0, 3, 1, 0]]
    assert (pillars.pitch_um, pillars.unit) == (0.3, "nm")
    assert pillars.columns["phase / turns"] == pytest.approx([0.7, 0.85, 1.0])
    assert pillars.columns["|T|"] == pytest.approx([0.83] * 3)
    assert section.x == pytest.approx([-0.45, 0.15, 0.45])
    turns = section.lines["phase modulo a turn"]
    assert np.exp(2j * np.pi * turns) == pytest.approx(
        np.exp(2j * np.pi * np.array([0.85, 1.0, 0.7])), abs=1e-9
    )
    assert ((turns >= 0) & (turns < 1)).all()


def test_a_far_field_has_squares_rings_and_beams(tmp_path):
    share = RNG.uniform(0, 1, (2, 5, 5))
    rings = np.array([[0.1, 0.3, 0.2, 0.05], [0.4, 0.0, 0.1, 0.2]])
    arrays = {
        "share": share,
        "sine": np.array([-0.5, -0.25, 0.0, 0.25, 0.5]),
        "angles_deg": np.array([[0.0, 0.0], [12.0, -3.5]]),
        "rings": rings,
        "beams": np.array([[0.0, 0.1, -0.2, 0.6], [1.0, 0.3, 0.05, 0.25]]),
        "error": np.array([2e-5, 7e-5]),
        "transmitted": np.array([0.8124, 0.7]),
    }
    store.save(
        tmp_path / "far.h5", "far-field", arrays, attributes={"wavelength_um": 0.6335}
    )
    images, cone, beams = artefacts.far_field_panels(tmp_path / "far.h5")
    assert images.values == pytest.approx(share / share.max())
    assert (images.step_um, images.across) == (0.25, "sine")
    assert list(images.axes[0].values) == ["0, 0 deg", "12, -3.5 deg"]
    assert (
        "light of 633.5 nm, in squares 0.25 wide; relative error 7.0e-05."
        in images.caption
    )
    assert cone.x == pytest.approx(
        [math.degrees(math.asin(s)) for s in (0.25, 0.5, 0.75, 1.0)]
    )
    assert cone.lines["share"] == pytest.approx(
        np.array([[0.1, 0.4, 0.6, 0.65], [0.4, 0.4, 0.5, 0.7]])
    )
    assert beams.rows == [
        ("0, 0 deg", 0.1, -0.2, 0.6),
        ("12, -3.5 deg", 0.3, 0.05, 0.25),
    ]
    assert (
        beams.caption == "Passes the pillars from 0, 0 deg: 0.812, 12, -3.5 deg: 0.700."
    )


def test_a_near_field_has_sizes_of_its_parts_and_light_that_goes_up(tmp_path):
    held = {"heights_um": np.array([0.1, 0.25]), "z_um": np.array([-0.2, 0.1, 0.7001])}
    for name, shape in (("xz", (3, 4)), ("yz", (3, 5)), ("xy", (2, 5, 4))):
        for field in ("e", "h"):
            held[f"{name}/{field}"] = RNG.normal(size=(3, *shape)) + 1j * RNG.normal(
                size=(3, *shape)
            )
        held[f"{name}/index"] = RNG.uniform(1, 3, shape) + 0.2j
    about = {
        "step_um": 0.02,
        "wavelength_um": 0.8512,
        "error_xz": 0.01,
        "error_yz": 0.02,
        "error_xy": 0.03,
    }
    store.save(tmp_path / "near.h5", "near-field", held, attributes=about)
    found = artefacts.near_field_panels(tmp_path / "near.h5")
    assert [one.title for one in found] == [
        "Along x and z",
        "Along y and z",
        "Across, along x and y",
    ]
    for panel, name in zip(found, ("xz", "yz", "xy"), strict=True):
        e, h = held[f"{name}/e"], held[f"{name}/h"]
        parts = [
            np.sqrt((np.abs(e) ** 2).sum(0)),
            *np.abs(e),
            np.sqrt((np.abs(h) ** 2).sum(0)),
            held[f"{name}/index"].real,
        ]
        want = np.stack(parts)
        assert panel.values == pytest.approx(
            want if name == "xy" else want[..., ::-1, :]
        )
        assert list(panel.axes[0].values) == [
            "|E|",
            "|Ex|",
            "|Ey|",
            "|Ez|",
            "|H|",
            "index",
        ]
        assert panel.step_um == 0.02
        assert f"For light of {851.2:g} nm" in panel.caption
        assert f"relative error {about[f'error_{name}']:.1e}" in panel.caption
        assert ("z from -0.2 to 0.7001 um, 0 at the foot" in panel.caption) is (
            name != "xy"
        )
    assert (found[2].axes[1].name, found[2].axes[1].unit) == ("height", "nm")
    assert found[2].axes[1].values == pytest.approx([100, 250])


def test_any_artefact_shows_arrays_of_eight_or_more_and_a_table_of_all(tmp_path):
    arrays = {
        "a": np.arange(8.0),
        "b": np.arange(7.0),
        "c": RNG.normal(size=(3, 8, 9)),
        "d": RNG.uniform(1, 2, (9, 7)),
        "e": np.array([1.0, np.nan, np.inf] * 3),
        "f": np.zeros((0, 9, 9)),
        "g": np.abs(RNG.normal(size=(8, 8))),
        "h": np.ones(9, complex),
    }
    store.save(
        tmp_path / "any.h5",
        "anything",
        arrays,
        attributes={"note": "x" * 250, "size": 3.5},
    )
    *panels, table = artefacts.plain_panels(tmp_path / "any.h5")
    assert [one.title for one in panels] == ["a", "c", "e", "g"]
    a, c, e, g = panels
    assert a.x.tolist() == list(range(8))
    assert a.lines["a"].tolist() == list(range(8))
    assert c.values == pytest.approx(arrays["c"])
    assert [(axis.name, list(axis.values)) for axis in c.axes] == [
        ("axis 0", [0, 1, 2])
    ]
    assert (c.signed, g.signed, c.step_um, c.across) == (True, False, 1.0, "samples")
    assert np.isfinite(e.lines["e"]).all()
    rows = dict(table.rows)
    assert rows["note"] == "x" * 197 + "..."
    assert rows["size"] == "3.5"
    assert rows["c"] == "float64 (3, 8, 9)"
    assert artefacts._short("y" * 199) == "y" * 199
    assert len(artefacts._short("y" * 200)) == 200
