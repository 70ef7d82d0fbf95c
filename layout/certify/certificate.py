"""The exposure certified: what the written files and their dose table make, by a simulator that the correction lacks.

Threshold model: the edge of a shape comes out where the exposure is half of what a wide area of dose 1 receives. The
diameter in the resist follows from the exposure across the edge of the shape's own disc and its background; the etch
adds the bias of the process.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from layout.certify import background
from layout.files import MaskContent, flat
from layout.process import LayerNumber, Process
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm

THRESHOLD = 0.5
_WIDE_UM = 2.0  # Gaussians from here on are summed on pixels
_ROUND = 0.85  # 4 pi area / perimeter^2 above this is a round pillar
_LEVELS = 256  # of the table of edges for each shape
MOST_ERROR, MOST_NM = 0.01, 1.0  # what a sound exposure keeps


@dataclass(frozen=True, eq=False, slots=True)
class Certificate:
    """What comes out, for every round pillar that is written.

    x_um, y_um: (n,) places. drawn_nm, resist_nm, made_nm: (n,) diameters: equal-area of the polygon, in the resist,
    at half height after the etch (bias of a full lattice). exposure: (n,) of the drawn edge, relative to dose-to-size.
    judged: (n,) false for the dose test, which is wrong on purpose.
    undosed: layers with shapes and no dose.
    """

    x_um: Array
    y_um: Array
    drawn_nm: Array
    resist_nm: Array
    made_nm: Array
    exposure: Array
    judged: Array
    undosed: tuple[LayerNumber, ...] = ()

    @property
    def worst_exposure(self) -> float:
        """Largest |exposure - 1| of the judged pillars."""
        return float(np.abs(self.exposure[self.judged] - 1).max(initial=0.0))

    @property
    def worst_nm(self) -> float:
        """Largest |diameter in the resist - drawn|."""
        return float(np.abs(self.resist_nm - self.drawn_nm)[self.judged].max(initial=0.0))

    @property
    def ok(self) -> bool:
        """Whether every judged pillar has a dose and keeps 1 % of dose-to-size and 1 nm."""
        return not self.undosed and self.worst_exposure <= MOST_ERROR and self.worst_nm <= MOST_NM


def certify(content: MaskContent, doses: Mapping[LayerNumber, float], process: Process) -> Certificate:
    """Simulate the exposure of a mask that was read back, with its dose table.

    Accuracy: backscatter to 1e-3 of itself (pixels of an eighth of its range), edges to 0.01 nm; rectangles and other
    shapes count in the background, pillars are judged.

    Raises:
        ProcessError: no double or triple Gaussian is given, or no round pillar is in the file.
    """
    terms = _terms(process)
    fixed = (process.layers.aperture[0], process.layers.outline[0], process.layers.fields[0])
    pillars, others, undosed = _gathered(content, doses, fixed)
    place, mass, kind = pillars
    x, y = place[0], place[1]
    sizes = np.array(sorted({float(k) for k in np.unique(kind)}))
    far, back = np.zeros(len(x)), mass[1]
    for range_um, weight in terms:
        if range_um >= _WIDE_UM:
            all_x, all_y, carried = (np.concatenate(pair) for pair in zip((x, y, mass[0]), others, strict=True))
            far += weight * background.wide(all_x, all_y, carried, (x, y), range_um)
        elif range_um > 0.05 * float(sizes.max()):
            far += weight * background.beside(x, y, mass[0], kind / 2, range_um)
    near = [(a, w) for a, w in terms if a < _WIDE_UM]
    wide_self = sum(w / (np.pi * a**2) for a, w in terms if a >= _WIDE_UM)
    far -= wide_self * mass[0]
    near += [(a, w) for a, w in terms if a >= _WIDE_UM]  # exact for the shape itself
    exposure, resist = _edges(kind, sizes, back, far, near)
    drawn = kind / nm
    test = place[2] == process.layers.dose[0]
    made = process.made_diameter_nm(resist / nm)
    return Certificate(x, y, drawn, resist / nm, made, exposure / THRESHOLD, ~test, undosed)


def _terms(process: Process) -> list[tuple[float, float]]:
    """(range, weight) of the Gaussians, weights of sum 1."""
    e = process.exposure
    if e.alpha_um is None or e.beta_um is None or e.eta is None:
        raise ProcessError(f"the exposure cannot be certified: [exposure] needs {e.missing}")
    found = [(e.alpha_um, 1.0), (e.beta_um, e.eta)] + ([] if e.gamma_um is None else [(e.gamma_um, e.nu)])
    total = sum(weight for _, weight in found)
    return [(range_um, weight / total) for range_um, weight in found]


def _gathered(
    content: MaskContent, doses: Mapping[LayerNumber, float], fixed: tuple[int, ...]
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array], tuple[LayerNumber, ...]]:
    """Pillars: (x, y, layer), (area * dose, dose), diameter; others as (x, y, area * dose); layers without dose."""
    unit = content.unit_nm * nm
    rows: list[tuple[Array, Array, float, float, float, float]] = []
    spots: list[Array] = [np.empty((0, 3))]
    missing: set[LayerNumber] = set()
    for shape in (s for top in content.tops for s in flat.shapes(content, top)):
        if shape.layer[0] in fixed:
            continue
        if shape.layer not in doses:
            missing.add(shape.layer)
            continue
        area, centre, roundness = _measured(shape.outline * unit)
        dose, x, y = doses[shape.layer], shape.x * unit, shape.y * unit
        if roundness > _ROUND:
            wide = 2 * (area / np.pi) ** 0.5
            rows.append((x + centre[0], y + centre[1], float(shape.layer[0]), area * dose, dose, wide))
        else:
            x, y = x + centre[0], y + centre[1]
            spots.append(np.column_stack([x, y, np.full(len(x), area * dose)]))
    if not rows:
        raise ProcessError("the mask holds no round pillar with a dose; nothing can be certified")
    x, y = (np.concatenate([r[k] for r in rows]) for k in (0, 1))
    layer, carried, given, size = (np.concatenate([np.full(len(r[0]), r[k]) for r in rows]) for k in (2, 3, 4, 5))
    other = np.concatenate(spots)
    place = np.stack([x, y, layer])
    return (place, np.stack([carried, given]), size), (other[:, 0], other[:, 1], other[:, 2]), tuple(sorted(missing))


def _measured(points: Array) -> tuple[float, Array, float]:
    """Area, centroid and roundness of a polygon."""
    after = np.roll(points, -1, axis=0)
    cross = points[:, 0] * after[:, 1] - after[:, 0] * points[:, 1]
    area = float(cross.sum()) / 2
    centre = ((points + after) * cross[:, None]).sum(0) / (6 * area)
    around = float(np.hypot(*(after - points).T).sum())
    return abs(area), centre, 4 * np.pi * abs(area) / around**2


def _edges(kind: Array, sizes: Array, dose: Array, far: Array, terms: list[tuple[float, float]]) -> tuple[Array, Array]:
    """Exposure of the drawn edge, and diameter at which the exposure is the threshold, um."""
    exposure, made = np.empty(len(kind)), np.empty(len(kind))
    order = np.argsort(kind, kind="stable")
    bounds = np.searchsorted(kind[order], sizes)
    for size, some in zip(sizes.tolist(), np.split(order, bounds[1:]), strict=True):
        radius, own = _profile(size, terms)
        exposure[some] = dose[some] * np.interp(size / 2, radius, own) + far[some]
        wanted = (THRESHOLD - far[some]) / dose[some]
        made[some] = 2 * np.interp(-wanted, -own, radius)
    return exposure, made


def _profile(size_um: float, terms: list[tuple[float, float]]) -> tuple[Array, Array]:
    """(radii, exposure) of a disc of unit dose about its edge: the non-central chi-square of two degrees."""
    from scipy.special import chndtr

    core = min(a for a, _ in terms)
    span = min(size_um / 2 * 0.9, 4 * core)
    radius = np.linspace(size_um / 2 - span, size_um / 2 + span, 2 * _LEVELS + 1)
    own = sum(w * chndtr(2 * (size_um / 2 / a) ** 2, 2.0, 2 * (radius / a) ** 2) for a, w in terms)
    return radius, np.asarray(own)
