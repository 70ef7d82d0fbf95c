"""Light of colours that the library does not reach is told, in numbers."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import verdict
from characterize.model import KnownValue


def lens(low_um, high_um):
    return b.row(proxy=replace(b.proxy(), wavelengths_um=(low_um, high_um)))


def known(wide_nm):
    return {"bandwidth_nm": KnownValue("bandwidth_nm", wide_nm, 0.2)}


@pytest.mark.parametrize(
    ("low_um", "high_um", "wide_nm"),
    [(0.84, 0.86, 14.0), (0.846, 0.853, 2.5), (0.85, 0.85, 0.9)],
)
def test_a_spectrum_within_twice_the_library_is_quiet(low_um, high_um, wide_nm):
    assert verdict.spectrum_text(lens(low_um, high_um), known(wide_nm)) == []


@pytest.mark.parametrize(
    ("low_um", "high_um", "wide_nm"),
    [(0.84, 0.86, 15.1), (0.846, 0.853, 5.1), (0.85, 0.85, 1.1)],
)
def test_a_wider_one_is_told(low_um, high_um, wide_nm):
    (words,) = verdict.spectrum_text(lens(low_um, high_um), known(wide_nm))
    assert f"from {850 - 2 * wide_nm:.0f} to {850 + 2 * wide_nm:.0f} nm" in words
    assert f"known from {low_um * 1e3:.0f} to {high_um * 1e3:.0f} nm" in words
    assert "sweep the library" in words
