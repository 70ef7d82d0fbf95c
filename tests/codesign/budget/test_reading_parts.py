"""Parts of a reader's budget, by typed-in errors and images that are names: what each
cause adds, and to what.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from codesign.budget import reading
from codesign.budget.entry import more
from codesign.budget.reading import Reading
from codesign.optics import OpticsConfig


class Lens:
    """Images by name."""

    def __init__(self, name="here"):
        self.name, self.whole = name, f"{name} whole"

    def one_wavelength(self, wavelength_um):
        return f"{self.name} at {wavelength_um:.4f} um"

    def one_psf(self):
        return f"{self.name} of one psf"

    def evenly_lit(self):
        return f"{self.name} evenly lit"


APART = {
    ("here at 0.8430 um", "here whole"): 0.31,
    ("here of one psf", "here whole"): 0.12,
    ("here evenly lit", "here whole"): 0.05,
    ("narrow of one psf", "narrow whole"): 0.23,
}
TURNS = {"here at 0.8430 um": 0.011, "here of one psf": 0.007, "here evenly lit": 0.004}


@pytest.fixture
def reader(monkeypatch):
    """A reader of ``believed`` settings on a device of a line of 24 nm at 843 nm."""

    def made(**believed):
        about = {
            "aperture_mm": 0.3,
            "sensor_distance_mm": 2.0,
            "wavelength_nm": 843.0,
            "polynomials": 0,
        }
        found = Reading.__new__(Reading)
        trainer = SimpleNamespace(optics=OpticsConfig(**about | believed))
        found.source = SimpleNamespace(
            run=SimpleNamespace(trainer=trainer), row={"mmacs": 31.4}
        )
        found.optics = OpticsConfig(**about, image="true", fwhm_nm=24.0, filter_nm=55.0)
        found.true, found._error_rad = Lens(), 0.0
        found._device = lambda settings: (
            Lens("narrow") if not (settings.fwhm_nm or settings.filter_nm) else None
        )
        found.turned = lambda optics, base: (
            TURNS[optics] if base == "here whole" else math.nan
        )
        return found

    monkeypatch.setattr(
        reading, "image_difference", lambda one, other: APART[one, other]
    )
    return made


def test_a_cause_adds_what_the_error_has_more_in_quadrature():
    assert [
        more(*pair) for pair in ((0.05, 0.03), (0.04, 0.05), (0.041, 0.04))
    ] == pytest.approx([0.04, 0.0, 9e-3])


def test_a_reader_trained_on_one_chief_ray_does_not_know_field_radiometry_and_spectrum(
    reader,
):
    found = list(reader(image="uniform")._unknown())
    assert [(link, optics, psf) for link, optics, psf, _ in found] == [
        ("field", "narrow evenly lit", 0.23),
        ("radiometry", "narrow whole", 0.0),
        ("spectrum", "here whole", 0.31),
    ]
    narrow = reader(image="uniform")
    narrow.optics = OpticsConfig(aperture_mm=0.3, sensor_distance_mm=2.0, image="true")
    assert [link for link, *_ in narrow._unknown()] == ["field", "radiometry"]
    (spectrum,) = reader(image="true", fwhm_nm=10.0)._unknown()
    assert spectrum[:3] == ("spectrum", "here whole", 0.31)
    assert spectrum[3].startswith("24 nm before a reader trained at 10 nm")
    assert not list(reader(image="true", fwhm_nm=24.0)._unknown())


def test_what_the_reader_was_trained_with_is_switched_off_and_does_not_count(reader):
    found = list(reader(image="true", fwhm_nm=24.0)._known())
    told = [(one.link, one.psf, one.gaze_rad, one.counted) for one in found]
    assert told == [
        ("field", 0.12, 0.007, False),
        ("radiometry", 0.05, 0.004, False),
        ("spectrum", 0.31, 0.011, False),
    ]
    assert [one.link for one in reader(image="true", fwhm_nm=10.0)._known()] == [
        "field",
        "radiometry",
    ]
    assert not list(reader(image="uniform")._known())
    alone = reader(image="uniform")
    alone.optics = OpticsConfig(aperture_mm=0.3, sensor_distance_mm=2.0, image="true")
    (spectrum,) = alone._known()
    assert (spectrum.link, spectrum.psf, spectrum.gaze_rad, spectrum.counted) == (
        "spectrum",
        0.0,
        0.0,
        True,
    )


def test_the_pupil_costs_at_most_what_all_that_is_read_costs(reader):
    """0.02 before; the pupil alone 0.06 by the sphere, all that is read 0.05: 0.0458
    and then nothing more. Where the
    sphere does better, the rest is the slippage's."""
    for alone, both in ((0.06, 0.05), (0.03, 0.05)):
        made = reader()
        made._error_rad, made.believed = 0.02, "trained"
        answers = {"pupil": alone, "all": both}
        made._read = lambda optics, quiet=False: (
            SimpleNamespace(pupil_mm="p", slip_mm="s", kind="all"),
            "axis",
        )
        made._error = lambda read, how, told=answers: told[
            getattr(read, "kind", "pupil")
        ]
        pupil, slippage = made._reader(SimpleNamespace(slip_mm="true"), "sphere")
        first = min(alone, both)
        assert pupil.gaze_rad == pytest.approx(math.sqrt(first**2 - 0.02**2))
        assert slippage.gaze_rad == pytest.approx(math.sqrt(both**2 - first**2))
        assert (pupil.link, slippage.link) == ("reader, pupil", "reader, slippage")


def test_errors_are_of_axial_frames_that_calibrated_nobody(reader, monkeypatch):
    made = reader()
    made.trial = SimpleNamespace(
        subject=np.zeros(6), group=lambda kind: np.array([1, 1, 0, 1, 1, 0], bool)
    )
    made.config = SimpleNamespace()
    monkeypatch.setattr(
        reading.gaze_experiment, "calibrating", lambda trial, config: np.array([1, 2])
    )
    assert made._off(np.array([2.0, 50.0, 70.0, 5.0, 8.0, 90.0])) == pytest.approx(
        math.radians(5.0)
    )
    made.subjects = [
        SimpleNamespace(labels=SimpleNamespace(slip_um=np.zeros(n))) for n in (4, 7, 2)
    ]
    assert made._starts().tolist() == [0, 4, 11]
