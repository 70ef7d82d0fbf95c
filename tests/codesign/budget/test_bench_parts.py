"""A bench and a chain between their parts: which optics, which settings, and in which order they are compared."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.budget import chain, prepared
from codesign.budget.entry import Entry
from codesign.optics import Numerics

UNKNOWN = torch.tensor([[3e-3, 4e-3, 9.0], [0.0, 1e-3, 5.0]])  # two eyes: both angles, and a third unknown


def test_an_entry_without_a_run_is_of_the_image_and_of_the_linear_estimator(monkeypatch):
    """Mean over the eyes of both angles together: 5 and 1 mrad; the third unknown is no angle."""
    asked = []

    def different(one, other):
        asked.append((one, other))
        return 0.7

    monkeypatch.setattr(prepared, "image_difference", different)
    about = SimpleNamespace(device=SimpleNamespace(whole="whole"), reading=None, shift=lambda one, other: UNKNOWN)
    found = prepared.Bench.entry(about, "glass", "bare", "said", phase_rad=0.2)
    assert (found.link, found.phase_rad, found.psf, found.method) == ("glass", 0.2, 0.7, "said")
    assert found.gaze_rad == pytest.approx(3e-3, rel=1e-6)
    assert asked == [("bare", "whole")]


def test_an_entry_with_a_run_is_of_its_network(monkeypatch):
    def changed(link, optics, base, method, *, phase_rad):
        return Entry(link, phase_rad, 0.4, 0.5, f"{method}: {optics} against {base}")

    about = SimpleNamespace(device=SimpleNamespace(whole="whole"), reading=SimpleNamespace(changed=changed))
    found = prepared.Bench.entry(about, "glass", "bare", "said", phase_rad=0.2)
    assert found == Entry("glass", 0.2, 0.4, 0.5, "said: bare against whole")


def test_a_shift_is_the_answer_to_the_one_less_that_to_the_other(monkeypatch):
    light = {"one": torch.tensor([[5.0, 2.0]]), "other": torch.tensor([[1.5, 4.0]])}
    monkeypatch.setattr(prepared.task, "electrons", lambda eyes, optics, setting: light[optics] * eyes * setting)
    reader = SimpleNamespace(shift=lambda electrons: 2 * electrons)
    about = SimpleNamespace(eyes=SimpleNamespace(anchor=3.0), setting=7.0, reader=reader)
    assert prepared.Bench.shift(about, "one", "other").tolist() == [[2 * 21 * 3.5, -2 * 21 * 2.0]]


@pytest.mark.parametrize("fwhm_nm", [0.0, 30.0])
def test_kernels_are_of_the_designed_pillars_and_the_light_s_width(monkeypatch, fwhm_nm):
    def kernels(*given, **named):
        return given, named

    aperture = SimpleNamespace(designed=lambda: "table", maps=lambda table: f"maps of {table}")
    monkeypatch.setattr(prepared, "kernels", kernels)
    given = SimpleNamespace(fwhm_nm=fwhm_nm)
    about = SimpleNamespace(aperture=aperture, lens="lens", window="window", given=given)
    want = ("lens", "maps of table", "numerics", "window"), {"fwhm_nm": fwhm_nm}
    assert prepared.Bench.basis(about, "numerics") == want
    monkeypatch.setattr(chain, "kernels", kernels)
    config = SimpleNamespace(led_fwhm_nm=fwhm_nm)
    one = SimpleNamespace(aperture=aperture, lens="lens", window="window", config=config)
    numerics = Numerics.__new__(Numerics)
    found = chain.Chain.optics(one, "table", numerics)
    assert found == (("lens", "maps of table", numerics, "window"), {"fwhm_nm": fwhm_nm})


def test_a_true_image_is_of_the_table_s_pillars_at_the_tolerance_asked(monkeypatch):
    monkeypatch.setattr(chain, "gathered", lambda lens, *maps: (lens, *maps))
    asked = []

    def at(tolerance):
        asked.append(tolerance)
        return SimpleNamespace(image=lambda *, wave: wave)

    aperture = SimpleNamespace(maps=lambda table: (f"phase of {table}", f"level of {table}"))
    one = SimpleNamespace(aperture=aperture, lens="lens", device=at)
    assert chain.Chain.optics(one, "table", 0.02) == ("lens", "phase of table", "level of table")
    assert asked == [0.02]


@pytest.mark.parametrize("fwhm_nm", [0.0, 30.0])
def test_the_device_of_a_chain_has_its_lens_window_and_light(monkeypatch, fwhm_nm):
    """Windows of PSFs reach as far as the margin to either side; light of no width is one wavelength."""
    monkeypatch.setattr(chain, "gathered", lambda lens, *maps: maps)
    monkeypatch.setattr(chain, "device", lambda wave, grid, **named: (wave, grid, named))
    setting = SimpleNamespace(pixels=24, pitch_um=18.0, margin=5)
    lens = SimpleNamespace(layers="layers", sensor_distance_um=2000.0)
    one = SimpleNamespace(
        config=SimpleNamespace(task=setting, led_fwhm_nm=fwhm_nm, wavelength_nm=850.0),
        lens=lens, eyes=SimpleNamespace(depths_um=np.array([2e4, 3e4])),
        aperture=SimpleNamespace(designed=lambda: "table", maps=lambda table: (table, "level")),
    )  # fmt: skip
    wave, grid, named = chain.Chain._device(one, 0.03)
    assert wave == ("table", "level")
    assert (grid.samples, grid.step_um, grid.margin, grid.window) == ((24, 24), 18.0, 5, 11)
    spectrum = named.pop("spectrum")
    assert named == {"layers": "layers", "distance_um": 2000.0, "tolerance": 0.03}
    assert (spectrum is None) == (not fwhm_nm)
    if spectrum is not None:
        assert (spectrum.peak_nm, spectrum.fwhm_nm) == (850.0, 30.0)
