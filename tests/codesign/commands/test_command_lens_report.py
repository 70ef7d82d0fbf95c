"""``metalens lens-report``: figures over field and wavelength against the closed forms
of a thin flat lens, page and numbers.
"""

import json
import math

import numpy as np
import pytest

from metalens import design, lens
from metalens.cell import Cell, Index
from metalens.design import Focus
from tests.command_line import call
from tests.proxies import proxy_of

CELL = Cell(pitch_um=0.4, pillar=Index(3.6), substrate=Index(1.45))
LEVEL = 0.9  # |t| of every pillar
PROXY = proxy_of([0.0, 3 * math.pi], [LEVEL], (0.08, 0.32), 0.85, 1e-6)
FOCUS_UM, RADIUS_UM = 400.0, 40.0


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    focus = Focus(0.85, FOCUS_UM)
    made, _ = design.make(
        design.phase_of(None, focus, radius_um=RADIUS_UM), focus,
        aperture_um=2 * RADIUS_UM, cell=CELL, proxy=PROXY,
    )  # fmt: skip
    lens.save(folder / "lens.h5", made)
    words = f"lens-report {folder}/lens.h5 -o {folder}/lens.html --quiet"
    assert call(f"{words} --angles-deg 0 7 13 --frequencies-per-mm 60 120") == 0
    (numbers,) = json.loads((folder / "lens.json").read_text()).values()
    return folder, numbers


def test_rays_over_the_field_are_those_of_a_thin_flat_lens(report):
    """Without a stop the chief ray goes on through the middle: no distortion; close rays
    of a wave at angle a meet f cos³ a (tangential) and f cos a (sagittal) behind it.
    """
    field = report[1]["field"]
    cosine = np.cos(np.radians([0, 7, 13]))
    assert np.abs(field["distortion"]).max() < 2e-6
    chief_um = FOCUS_UM * math.tan(math.radians(13))
    assert field["chief_um"][2][0] == pytest.approx(chief_um, abs=0.01)
    want = FOCUS_UM * (np.stack([cosine**3, cosine], 1) - 1)
    errors = np.array(field["close_error_um"])
    assert (np.abs(field["close_um"] - want) < 5 * errors + 0.2).all()
    assert field["illumination"] == pytest.approx(cosine**4, rel=1e-3)


def test_the_focus_on_the_axis_is_the_airy_pattern_and_the_pillars_pass_their_level(
    report,
):
    axis, *_, rim = report[1]["focus"]
    sine = math.sin(math.atan(RADIUS_UM / FOCUS_UM))
    assert axis["fwhm_um"] == pytest.approx(0.5145 * 0.85 / sine, rel=0.01)
    assert axis["strehl"] == pytest.approx(1, abs=0.01)
    assert axis["behind_pillars"] == pytest.approx(LEVEL**2, rel=1e-6)
    # 0.855 of an Airy pattern lies within three FWHM; sites are 1 % of the radius
    assert axis["in_window"] * axis["in_focus"] == pytest.approx(0.855, rel=0.01)
    assert axis["efficiency"] == pytest.approx(0.855 * LEVEL**2, rel=0.01)
    # Maréchal: waves of defocus R² dz / (2 f² wavelength) of both foci at 13 degrees;
    # coma is 0.006 waves
    cosine = math.cos(math.radians(13))
    away = [FOCUS_UM * (1 - cosine**power) for power in (3, 1)]
    tangential, sagittal = (sine**2 * z / (2 * 0.85) for z in away)
    variance = ((tangential + sagittal) / 2) ** 2 / 12
    variance += (tangential - sagittal) ** 2 / 24
    want = math.exp(-((2 * math.pi) ** 2) * variance)
    assert rim["strehl"] == pytest.approx(want, abs=0.01)


def test_the_page_shows_curves_psfs_and_tables(report):
    page = (report[0] / "lens.html").read_text("utf-8")
    assert page.count("data:image/png") == 3
    for words in (
        "distortion / %",
        "T at 60 / mm",
        "FWHM / µm",
        "Strehl",
        "behind the pillars",
    ):
        assert words in page


def test_a_wavelength_outside_the_library_is_refused_by_name(report, capsys):
    folder, _ = report
    words = f"lens-report {folder}/lens.h5 -o {folder}/other.html"
    assert call(f"{words} --wavelengths-nm 700") == 2
    assert "sweep a library over the wavelengths" in capsys.readouterr().err
    assert not (folder / "other.html").exists()
