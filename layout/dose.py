"""Proximity correction: a dose for each pillar, so that all edges receive the exposure that clears the resist.

The exposure at the edge of pillar i is d_i s(D_i) + B_i: its own disc, and the background B = K * (A d) of all
others. Setting it to 1/2, the edge of a wide area of dose 1, gives d = (1/2 - B) / s, and for the background
the linear equation B = K * [(1/2 - B) A / s], solved on a coarse grid of nodes. What varies from pillar to
pillar is then the product of a number per diameter and a smooth function of place.
"""

from dataclasses import dataclass

import numpy as np

from layout import exposure
from layout.exposure import CLEARS, PointExposure
from layout.nodes import Convolution, convolution
from layout.pattern import NONE, Pattern, pattern
from layout.process import Exposure, Process
from layout.uniformity import Tally, Uniformity, sampled_error
from metalens.errors import ProcessError
from metalens.lens import DiameterMap
from metalens.store import Array

_UNIT_UM = 1e-4  # resolution of the diameters in the table


@dataclass(frozen=True, eq=False, slots=True)
class DoseResult:
    """Doses of a mask.

    factors: (classes,) relative dose of each class, rising; dose_uC_cm2: (classes,) the doses.
    classes: (y, x) uint8 class of each pillar, 255 where there is none.
    needed: classes that meet the tolerance; met: whether ``after`` keeps it (the writer may hold fewer).
    before, after: uniformity with the best single dose, and with these classes.
    error: largest difference of the relative exposure from the exact sum, at sample pillars.
    point: the point-exposure function that was used.
    """

    factors: Array
    dose_uC_cm2: Array
    classes: Array
    needed: int
    met: bool
    before: Uniformity
    after: Uniformity
    error: float
    point: PointExposure


def correct(written: DiameterMap, process: Process, *, samples: int = 8) -> DoseResult:
    """Dose classes for drawn pillars (``written``: the drawn diameters, bias taken off).

    Accuracy:
        the background is interpolated to some 1e-4 of itself; neighbours count as Gaussians of matched second
        moment. ``error`` of the result is measured at ``samples`` pillars against exact discs.

    Raises:
        ProcessError: tone ``negative``; no pillar; an unreadable point exposure; pillars finer than its core.
    """
    index = np.empty(written.diameter_um.shape, np.uint16 if written.pitch_um < 6 else np.uint32)
    for band in np.array_split(np.arange(len(index)), max(1, len(index) // 64)):
        rows = slice(band[0], band[-1] + 1)
        index[rows] = np.rint(written.diameter_um[rows] * (1 / _UNIT_UM))
    diameter_um = np.arange(int(index.max()) + 1) * _UNIT_UM
    return correct_table(index, diameter_um, written.pitch_um, process, samples=samples)


def correct_table(
    index: Array, diameter_um: Array, pitch_um: float, process: Process, *, samples: int = 8
) -> DoseResult:
    """As :func:`correct`, for pillars given as (y, x) ``index`` into a table of diameters, entry 0 for none."""
    if process.tone == "negative":
        raise ProcessError(
            "a dose per pillar needs drawn pillars, but tone is 'negative' (the gaps are drawn); "
            "draw the pillars, or set exposure.correct = false"
        )
    point = exposure.point_exposure(process.exposure)
    drawn = pattern(index, diameter_um, pitch_um, point=point)
    y, x = drawn.axes
    spread = convolution((y.nodes, x.nodes), y.step * pitch_um, point=drawn.far, hollow=drawn.hollow)
    per_own = np.divide(drawn.area_um2, drawn.own, out=np.zeros_like(drawn.own), where=drawn.count > 0)
    plain, wanted = drawn.gather(drawn.area_um2, per_own)
    alone, background = spread(plain), _solve(spread, wanted, self_weight=drawn.self_weight)
    factors, needed = _factors(drawn, background, wanted, process.exposure)
    mean = (drawn.area_um2 * drawn.own * drawn.count).sum() + (plain * alone).sum()
    tallies = Tally(float(mean / (drawn.area_um2 * drawn.count).sum())), Tally(CLEARS)
    classes, mass = _assign(drawn, (alone, background), factors, tallies)
    after = spread(mass)
    inside = wanted > 1e-3 * wanted.max()
    gentle = float(drawn.slope[drawn.count > 0].min())
    pillars = int(drawn.count.sum())
    achieved = tallies[1].result(pillars, gentle * float(factors[0]), float(abs(after - background)[inside].max()))
    return DoseResult(
        factors=factors,
        dose_uC_cm2=factors * process.exposure.base_uC_cm2,
        classes=classes[: index.shape[0], : index.shape[1]],
        needed=needed,
        met=achieved.worst <= process.exposure.tolerance,
        before=tallies[0].result(pillars, gentle),
        after=achieved,
        error=sampled_error(drawn, after, classes, factors, point=point, samples=samples),
        point=point,
    )


def _solve(spread: Convolution, mass: Array, *, self_weight: float) -> Array:
    """B = K * [(1/2 - B) mass] on the nodes, to 1e-8, by relaxation.

    self_weight: below 1; the eigenvalues of K * mass lie between -self_weight and the largest row sum.
    """
    bound = float(spread(mass).max())
    step = 2 / (2 + bound - self_weight)
    rate = max(1 - step * (1 - self_weight), step * (1 + bound) - 1, 1e-3)
    field = np.zeros_like(mass)
    for _ in range(int(np.ceil(np.log(1e-8) / np.log(rate)))):
        field += step * (spread((CLEARS - field) * mass) - field)
    return field


def _factors(drawn: Pattern, background: Array, mass: Array, settings: Exposure) -> tuple[Array, int]:
    """(dose factors, classes that the tolerance needs); the classes are equal steps of the logarithm.

    A tenth of the tolerance is left for the change of the background by the rounding of the doses.
    """
    inside = background[mass > 1e-3 * mass.max()]
    low, high = float(inside.min()), float(inside.max())
    own = drawn.own[drawn.count > 0]
    least, most = (CLEARS - high) / own.max(), (CLEARS - low) / own.min()
    allowed = np.log1p(0.9 * settings.tolerance / (1 - low / CLEARS))
    needed = max(1, int(np.ceil(np.log(most / least) / (2 * allowed) - 1e-9)))
    count = min(needed, settings.maximum_classes)
    return least * (most / least) ** ((np.arange(count) + 0.5) / count), needed


def _assign(
    drawn: Pattern, fields: tuple[Array, Array], factors: Array, tallies: tuple[Tally, Tally]
) -> tuple[Array, Array]:
    """((y, x) class of each pillar, node sums of area times dose); the tallies take in both exposures.

    fields: background on the nodes with dose 1 everywhere, and with the wanted doses.
    """
    y, x = drawn.axes
    alone, columns = (y.spread(field.T).T.astype(np.float32) for field in fields)
    own, area = drawn.own.astype(np.float32), drawn.area_um2.astype(np.float32)
    span = np.log(factors[-1] / factors[0])
    per_log = np.float32((len(factors) - 1) / span if span > 0 else 0)
    shift = (np.log(np.where(drawn.count > 0, drawn.own, 1)) + np.log(factors[0])).astype(np.float32) * per_log
    dose = np.zeros(NONE + 1, np.float32)
    dose[: len(factors)] = factors
    classes = np.empty(drawn.index.shape, np.uint8)
    rows = np.zeros((y.sites, x.nodes), np.float32)
    for band, index in drawn.bands():
        none, ones, field = index == 0, own.take(index, mode="clip"), x.spread(columns[band])
        level = np.log(np.float32(CLEARS) - field) * per_log - shift.take(index, mode="clip")
        classes[band] = np.clip(np.rint(level), 0, len(factors) - 1)
        classes[band][none] = NONE
        given = dose.take(classes[band], mode="clip")
        rows[band] = x.gather(area.take(index, mode="clip") * given)
        tallies[0].add(ones + x.spread(alone[band]), none)
        tallies[1].add(given * ones + field, none)
    return classes, y.gather(rows.T.astype(float)).T
