"""What a fit says of faulty captures, on frames of the independent pillar bench.

The bench (``tests/referees/pillar_bench.py``) sums over pillars one by one and shares
no code with the fit.
"""

import dataclasses
import functools
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "referees"))
import hidden_lens as hidden
import pillar_bench as bench

import characterize
from characterize.inference.estimate import FitOptions
from characterize.model import (
    PLACE,
    ForwardModel,
    FrameSetting,
    log_response_slopes,
    parameter_vector,
)
from metalens.core.errors import CaptureError, FitError

READ_NOISE_E = 7.3  # far from the 2 e that are assumed where nothing tells


@functools.lru_cache
def response():
    """Slopes of the small lens's pillars by height, index and sidewall."""
    return log_response_slopes(hidden.lens())


def fitted(capture, **options):
    """The fit of a capture of the small lens."""
    choice = FitOptions(scan_um=60.0, **options)
    return characterize.fit(capture, hidden.lens(), choice, response=response())


def seen(seed=1, faults=None, **session):
    """A capture of the small lens."""
    one = hidden.session(seed, **session)
    return bench.shoot(hidden.lens(), bench.with_faults(one, **(faults or {}))).capture


def stating(capture, **about):
    """The capture with entries of its description."""
    return dataclasses.replace(capture, about={**capture.about, **about})


@pytest.mark.slow
def test_read_noise_of_dark_frames_counts_where_the_gain_is_stated():
    """Chi-square of 1500 pixels scatters by 0.04; with 2 e for 7.3 it would be 1.6."""
    capture = stating(seen(read_noise_e=READ_NOISE_E, peak_e=1500.0), gain_e=3.7)
    built = fitted(capture)
    assert built.trusted
    assert built.chi2_per_dof == pytest.approx(1, abs=0.14)
    said = " ".join(built.cautions)
    assert "gain 3.7 e/count as stated" in said
    assert "e, measured in 8 dark frames" in said
    assert "measured pixel by pixel in 8 dark frames" in said


def test_an_offset_that_weighs_as_light_costs_the_trust():
    """97 counts of 3.7 e are 359 e of variance that the frames do not have."""
    capture = stating(dataclasses.replace(seen(), dark=None), gain_e=3.7)
    built = fitted(capture, insist=True)
    assert not built.trusted
    assert any("far below 1" in words for words in built.problems)


def test_a_frame_with_full_wells_is_neither_brighter_nor_darker():
    """Wells of 2500 e under a peak of 6000."""
    built = fitted(seen(0, {"full_well_e": 2500.0}), insist=True)
    assert any("saturated" in words for words in built.cautions)
    assert not any("brighter or darker" in words for words in built.cautions)


def far(**faults):
    """The fit of a lens of 200 um on a faulty bench, and the session."""
    lens = hidden.lens(200.0, 550.0, 3000.0)
    depths = (2400.0, 2650.0, 2900.0, 3100.0, 3400.0, 3900.0)
    session = hidden.session(
        0, depths_um=depths, values=hidden.hidden(0, scale=3.0), pixels=40
    )
    session = bench.with_faults(session, **faults)
    shots = bench.shoot(lens, session).capture
    return characterize.fit(shots, lens, response=log_response_slopes(lens)), session


@pytest.mark.slow
def test_a_pixel_pitch_that_is_three_percent_off_is_named():
    built, _ = far(pixel_error=0.03)
    assert any("a wrong pixel pitch explains" in words for words in built.cautions)
    low, high = built.interval("pixel_percent")
    assert low < 3.0 < high


@pytest.mark.slow
def test_a_spectrum_of_thirty_nm_is_found_and_the_bias_lies_inside():
    built, session = far(led_nm=30.0)
    low, high = built.interval("bandwidth_nm")
    assert low < 30 / 2.3548 < high
    low, high = built.interval("bias_nm")
    assert low < session.of("bias_nm") < high


@pytest.mark.slow
def test_a_tilted_plate_of_glass_is_found_or_refused():
    """100 um of glass at 10 degrees, of which nobody says anything."""
    session = bench.with_faults(hidden.session(0), glass_um=100.0, glass_tilt_deg=10.0)
    try:
        built = fitted(bench.shoot(hidden.lens(), session).capture)
    except FitError:
        return
    low, high = built.interval("bias_nm")
    assert low < session.of("bias_nm") < high


def test_no_derivative_by_a_bias_that_is_beyond_the_known_pillars():
    """At 200 nm every pillar is as at the end of the range: images and differences of
    them stand still, and so must the derivative.
    """
    setting = FrameSetting(
        np.array(hidden.DEPTHS), np.zeros((6, 2)), np.ones(6), 1.5, 11, 14
    )
    model = ForwardModel(hidden.lens(), setting, response())
    x = parameter_vector({"bias_nm": 200.0, "log_gain": 9.0})
    more = x + 5.0 * (np.arange(len(x)) == PLACE["bias_nm"])
    frames, rates = model.images(x, ["bias_nm"])
    assert np.array_equal(model.images(more)[0], frames)
    assert np.abs(rates).max() == 0.0


@pytest.mark.parametrize(("unit", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6)])
def test_exposures_are_read_in_their_unit(tmp_path, unit, scale):
    tifffile = pytest.importorskip("tifffile")
    rng = np.random.default_rng(3)
    lines = [f"file,depth_mm,exposure_{unit}"]
    for name, time_s in (("a.tif", 0.0125), ("b.tif", 0.05)):
        frame = rng.integers(90, 3000, (7, 9)).astype(np.uint16)
        tifffile.imwrite(tmp_path / name, frame, photometric="minisblack")
        lines.append(f"{name},1.5,{time_s * scale:.6g}")
    (tmp_path / "stage.csv").write_text("\n".join(lines) + "\n")
    read = characterize.load(tmp_path)
    assert read.exposure_s == pytest.approx([0.0125, 0.05], rel=1e-9)
    assert read.position_um == pytest.approx([1500.0, 1500.0])


def test_planned_proportions_are_no_times(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    frame = np.arange(63, dtype=np.uint16).reshape(7, 9)
    tifffile.imwrite(tmp_path / "a.tif", frame, photometric="minisblack")
    (tmp_path / "stage.csv").write_text("file,depth_um,relative_exposure\na.tif,9,2\n")
    with pytest.raises(CaptureError, match="exposure_s"):
        characterize.load(tmp_path)
