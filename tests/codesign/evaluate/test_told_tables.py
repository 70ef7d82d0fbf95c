"""What the paper's tables say of typed measurements, worked out by hand: means over
depths, least light, intervals.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.evaluate import tables
from codesign.evaluate.optics import AxialInformation, ResolvedSettings, SceneEnergy

SETTING = ResolvedSettings(
    depths_mm=(16.0, 28.0), count=3, angles_deg=(0.0, 10.0), binnings=(1, 2), pixel_um=7.0, window_um=300.0,
    sample_um=2.0, radius_um=9.0, step_um=50.0,
)  # fmt: skip
INFORMATION = torch.tensor(
    [[[1.0, 2.0, 6.0], [0.5, 0.25, 0.15]], [[4.0, 0.5, 0.9], [0.2, 0.1, 0.9]]]
)
ENCIRCLED = torch.tensor([[0.71, 0.42, 0.93], [0.66, 0.88, 0.31]])
FOUND = AxialInformation(INFORMATION, ENCIRCLED, 0.013, torch.zeros(3, 5))
RNG = np.random.default_rng(31)


def energy(gaze, slip, separability, **more):
    parts = (
        torch.as_tensor(np.asarray(part, float)) for part in (gaze, slip, separability)
    )
    return SceneEnergy(
        *parts, **{"light": 0.87, "image_error": 0.026, "maps": torch.zeros(1)} | more
    )


def scenes(count=40):
    base = RNG.uniform(1.0, 9.0, count)
    return {
        "plain": energy(base, 2 * base, 2.1 * base),
        "mine": energy(
            1.7 * base * RNG.lognormal(0.0, 0.4, count),
            3.3 * base,
            2.5 * base,
            light=0.61,
        ),
    }


def test_axial_rows_are_means_over_the_depths_and_the_least_light():
    made = tables.format_tables({"mine": FOUND}, scenes(), SETTING)[0]
    assert list(made.rows[0]) == [
        "mine",
        "1 × 1",
        "3",
        "1.8",
        "0.42",
        "0.31",
    ]  # of (1, 2, 6) and (4, 0.5, 0.9)
    assert list(made.rows[1]) == ["", "2 × 2", "0.3", "0.4", "", ""]
    assert list(made.rows[-1]) == [
        "paper: proposed",
        "",
        "–",
        "1.25",
        "",
        "",
    ]  # it was measured at 5 to 20 degrees


def test_scenes_are_ratios_of_means_to_the_first_lens_and_not_means_of_ratios():
    shown = scenes()
    made = tables.format_tables({}, shown, SETTING)[1]
    first, mine = (shown[name].gaze.numpy() for name in ("plain", "mine"))
    assert made.rows[0][1] == "1.00 [1.00, 1.00]"
    assert made.rows[1][1].startswith(f"{mine.mean() / first.mean():.2f} [")
    assert made.rows[1][2] == "1.65 [1.65, 1.65]"
    angle = np.degrees(np.arccos((1 + 2 - 2.1) / (2 * math.sqrt(2))))
    assert list(made.rows[0][4:]) == [f"{angle:.1f}°", "0.87", "0.026"]
    assert made.rows[1][5] == "0.61"
    assert (
        abs((mine / first).mean() - mine.mean() / first.mean()) > 0.02
    )  # as these are drawn


def test_the_interval_of_a_ratio_of_means_is_that_of_the_delta_method():
    """95 %: 1.96 sigma of (a - ratio b) / mean b over the scenes, divided by root n; a
    bootstrap of 2000 draws has its
    own scatter of 4 % of that, its skewness takes 0.6 of a sigma over root n."""
    b = RNG.uniform(1.0, 9.0, 900)
    a = 1.7 * b * RNG.lognormal(0.0, 0.3, 900)
    value, low, high = tables.scene_ratio(torch.from_numpy(a), torch.from_numpy(b))
    sigma = np.std(a - value * b) / b.mean() / math.sqrt(900)
    assert value == pytest.approx(a.mean() / b.mean(), rel=1e-12)
    assert (high - low) / (2 * 1.96 * sigma) == pytest.approx(1, abs=0.1)
    assert (low + high) / 2 == pytest.approx(value, abs=0.2 * sigma)


def test_numbers_for_machines_are_those_of_the_record():
    shown = scenes()
    told = tables.table_values(
        {"mine": FOUND}, {"plain": shown["plain"], "mine": shown["mine"]}, SETTING
    )
    assert told["depths_mm"] == [16.0, 22.0, 28.0]
    mine = told["lenses"]["mine"]
    assert mine["information_per_mm2"] == INFORMATION.tolist()
    assert (mine["psf_error"], mine["light_in_window"], mine["image_error"]) == (
        0.013,
        0.61,
        0.026,
    )
    assert mine["scene_ratios"]["slip"] == pytest.approx([1.65, 1.65, 1.65])
    assert mine["span_angle_deg"] == pytest.approx(
        float(torch.rad2deg(shown["mine"].angle_rad).mean())
    )
    unknown = {"mine": energy([1.0, 2.0], [1.0, 3.0], [1.0, 2.5], image_error=math.nan)}
    assert (
        tables.table_values({"mine": FOUND}, unknown, SETTING)["lenses"]["mine"][
            "image_error"
        ]
        is None
    )


def test_errors_of_psfs_and_images_above_what_is_aimed_at_are_failures_of_that_lens():
    shown = {
        "plain": energy([1.0], [2.0], [3.0]),
        "mine": energy([1.0], [2.0], [3.0], above="0.2 is too much"),
    }
    assert tables.table_failures(
        {"plain": FOUND, "mine": FOUND}, shown, replace(SETTING, tolerance=0.013)
    ) == ["mine: 0.2 is too much"]
    told = tables.table_failures(
        {"mine": FOUND}, {"plain": shown["plain"]}, replace(SETTING, tolerance=0.0129)
    )
    assert told == ["mine: the PSFs' error 0.013 is above axial.tolerance = 0.0129"]
