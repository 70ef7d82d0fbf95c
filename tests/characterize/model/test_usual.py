"""Priors and bounds in nm grow with the wavelength: a lens ten times as large in all
lengths has the same errors.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference.search import prior_of
from characterize.model import (
    NAMES,
    PARAMETERS,
    KnownValue,
    solving,
    type_b_sigma,
    usual_parameters,
)
from characterize.model.pillars import ChangeRange, PillarChange, PillarResponse
from metalens.fabrication import Sensitivity, coarser
from metalens.lens import DiameterMap

LARGER = 12.0  # of 0.85 um: 10.2 um


def larger(lens, factor):
    """The lens with every length so much larger, the light's among them: Maxwell's
    equations know no scale.
    """
    made, proxy, cell = lens.diameters, lens.proxy, lens.cell
    low, high = proxy.domain_um
    waves = tuple(factor * wave for wave in proxy.wavelengths_um)
    wide = dataclasses.replace(
        proxy, domain_um=(factor * low, factor * high), wavelengths_um=waves
    )
    return dataclasses.replace(
        lens,
        diameters=DiameterMap(factor * made.diameter_um, factor * made.pitch_um),
        proxy=wide,
        cell=dataclasses.replace(
            cell, pitch_um=factor * cell.pitch_um, height_um=factor * cell.height_um
        ),
        wavelength_um=factor * lens.wavelength_um,
        sensor_distance_um=factor * lens.sensor_distance_um,
        source_distance_um=factor * lens.source_distance_um,
    )


def of_larger(response, factor):
    """Derivatives by lengths fall as these grow, those by index and angle stay; power
    series of the diameter too.
    """
    powers = factor ** -np.arange(response.coefficients.shape[1])
    rates = np.array([1 / factor, *[1.0] * (len(response.coefficients) - 1)])
    return Sensitivity(
        response.coefficients * powers * rates[:, None], factor * response.center_um
    )


def test_what_is_in_nm_and_decentre_grow_with_long_waves_and_nothing_else_does():
    long, short = larger(b.lens(), LARGER), larger(b.lens(), 0.626)
    assert (
        coarser(short.wavelength_um) == 1.0
    )  # 532 nm: from the same writer, with its nanometres
    for row, much, same in zip(
        PARAMETERS,
        usual_parameters(NAMES, long),
        usual_parameters(NAMES, short),
        strict=True,
    ):
        factor = (
            LARGER
            if row.name.endswith("_nm") or row.name.startswith("decentre")
            else 1.0
        )
        assert (much.scale, much.sigma, much.unstated) == pytest.approx(
            (factor * row.scale, factor * row.sigma, factor * row.unstated)
        )
        assert (same.scale, same.sigma, same.unstated) == (
            row.scale,
            row.sigma,
            row.unstated,
        )
        if row.name != "distance_um":
            assert (much.low, much.high) == pytest.approx(
                (factor * row.low, factor * row.high)
            )
            assert (same.low, same.high) == (row.low, row.high)
    assert type_b_sigma("stitching_nm", long) == pytest.approx(60.0 * LARGER)
    assert [type_b_sigma(name, long) for name in ("glass_um", "pixel_percent")] == [
        100.0,
        1.0,
    ]


def test_metrology_stays_as_it_is_stated():
    known = {"bias_nm": KnownValue("bias_nm", -41.0, 3.0)}
    prior = prior_of(("bias_nm", "height_nm"), known, larger(b.lens(), LARGER))
    assert (prior.mean[0], prior.sigma.tolist()) == (
        -41.0,
        [3.0, pytest.approx(10.0 * LARGER)],
    )
    assert prior.high == pytest.approx([26.0 * LARGER, 28.0 * LARGER])


def test_a_larger_lens_has_the_same_pillars_at_larger_errors():
    """Two rooms of t, each over its own bounds: equal at errors as much larger, up to
    what either leaves out.
    """
    small, long = (PillarResponse(lens, response) for lens, response in _pair())
    assert long.nodes_um == pytest.approx(LARGER * small.nodes_um)
    for bias, tall, dense, wave in (
        (0.024, -0.02, 0.03, 2e-3),
        (-0.017, 0.026, -0.04, -3e-3),
    ):
        plain = PillarChange(
            (tall, dense, *[0.0] * (len(small.span.answers) - 2)), wave
        )
        grown = PillarChange((LARGER * tall, *plain.answers[1:]), LARGER * wave)
        want = small.exact(bias, plain)
        assert long.exact(LARGER * bias, grown) == pytest.approx(
            want, abs=1e-6
        )  # diameters are kept in single precision
        told = long.weights(np.array(LARGER * bias)) @ long.coefficients(grown)
        assert np.abs(long.basis.conj().T @ told - want).max() < 2 * max(
            long.error, 1e-4
        )


def _pair():
    return (b.lens(), b.RESPONSE), (
        larger(b.lens(), LARGER),
        of_larger(b.RESPONSE, LARGER),
    )


def test_solved_heights_span_the_bounds_of_the_lens():
    tall, dense = (amounts for *_, amounts in solving._changes(LARGER * 0.85))
    assert tall == pytest.approx(LARGER * np.array([-1, -0.5, 0, 0.5, 1]) * 0.02996)
    assert dense == pytest.approx(
        np.array([-1, -0.67, -0.33, 0, 0.33, 0.67, 1]) * 0.08025
    )
    assert ChangeRange.of(LARGER * 0.85).answers[:2] == pytest.approx(
        (tall[-1], dense[-1])
    )
