"""The exposure certified: what the written files and their dose table make, by a simulator that the correction lacks.

Threshold model: the edge of a shape comes out where the exposure is half of what a wide area of dose 1 receives. The
diameter of a pillar in the resist follows from the exposure across the edge of its own disc and its background; the
etch adds the bias of the process, for how alone the pillar stands, and its tilted walls. Of marks, labels and any
other shape the edges are sampled.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from layout.certify import background, outlines
from layout.certify.gathered import Pillars, Polygons, gathered
from layout.files import MaskContent
from layout.process import LayerNumber, Process, compiled
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm

THRESHOLD = 0.5
_WIDE_UM = 2.0  # Gaussians from here on are summed on pixels
_LEVELS = 256  # of the table of edges for each shape
MOST_ERROR, MOST_NM = 0.01, 1.0  # what a sound exposure keeps
EDGE_SHARE, EDGE_ERROR = 0.99, 0.02  # of marks: so many points keep it, and all of them this; doses step along an edge

Terms = list[tuple[float, float]]  # (range, weight) of Gaussians


@dataclass(frozen=True, eq=False, slots=True)
class Edges:
    """Edges of marks, labels and other shapes that are no round pillars.

    x_um, y_um: (n,) samples. exposure: (n,) relative to dose-to-size. shift_nm: (n,) how far outside the drawn edge it
    comes out in the resist. layer: (n,) layer numbers.
    """

    x_um: Array
    y_um: Array
    exposure: Array
    shift_nm: Array
    layer: Array


@dataclass(frozen=True, eq=False, slots=True)
class Certificate:
    """What comes out, for every round pillar that is written and along the edges of everything else.

    x_um, y_um: (n,) places. drawn_nm, resist_nm, made_nm: (n,) diameters: equal-area of the polygon, in the resist,
    at half height after the etch (bias for the density around it). exposure: (n,) of the drawn edge, relative to
    dose-to-size. lean_nm: foot less half-height diameter.
    layer: (n,) layer numbers. judged: (n,) false for the dose test, which is wrong on purpose.
    edges: of the other shapes. undosed: layers with shapes and no dose.
    """

    x_um: Array
    y_um: Array
    drawn_nm: Array
    resist_nm: Array
    made_nm: Array
    exposure: Array
    layer: Array
    judged: Array
    edges: Edges
    lean_nm: float = 0.0
    undosed: tuple[LayerNumber, ...] = ()

    @property
    def foot_nm(self) -> Array:
        """(n,) diameters at the foot."""
        return np.asarray(self.made_nm + self.lean_nm)

    @property
    def top_nm(self) -> Array:
        """(n,) diameters at the top."""
        return np.asarray(self.made_nm - self.lean_nm)

    @property
    def worst_exposure(self) -> float:
        """Largest |exposure - 1| of the judged pillars and of all edges."""
        worst = np.abs(self.exposure[self.judged] - 1).max(initial=0.0)
        return float(max(worst, np.abs(self.edges.exposure - 1).max(initial=0.0)))

    @property
    def worst_nm(self) -> float:
        """Largest |width in the resist - drawn|: diameters, and twice the shift of an edge."""
        worst = np.abs(self.resist_nm - self.drawn_nm)[self.judged].max(initial=0.0)
        return float(max(worst, 2 * np.abs(self.edges.shift_nm).max(initial=0.0)))

    @property
    def ok(self) -> bool:
        """Whether every shape has a dose and keeps 1 % of dose-to-size and 1 nm.

        Along the edges of marks and labels 99 of 100 points keep the 1 %, and all of them 2 %.
        """
        pillars = float(np.abs(self.exposure[self.judged] - 1).max(initial=0.0))
        off = np.abs(self.edges.exposure - 1)
        edges = not len(off) or (float((off <= MOST_ERROR).mean()) >= EDGE_SHARE and float(off.max()) <= EDGE_ERROR)
        return not self.undosed and pillars <= MOST_ERROR and edges and self.worst_nm <= MOST_NM


def certify(
    content: MaskContent, doses: Mapping[LayerNumber, float], process: Process, *, height_um: float = 0.0
) -> Certificate:
    """Simulate the exposure of a mask that was read back, with its dose table.

    Args:
        height_um: of the pillars, for their feet.

    Accuracy: backscatter to 1e-3 of itself (pixels of an eighth of its range), edges to 0.01 nm. Edges are sampled
    away from corners, which round off.

    Raises:
        ProcessError: no double or triple Gaussian is given, or no round pillar is in the file.
    """
    terms = _terms(process)
    fixed = (process.layers.aperture[0], process.layers.outline[0], process.layers.fields[0])
    pillars, others, undosed = gathered(content, doses, fixed)
    points = outlines.samples(others, max((a for a, _ in terms if a < _WIDE_UM), default=0.0))
    far, of_edges = _background(pillars, others, points.at_um, terms)
    exposure, resist = _developed(pillars, far, terms)
    made = process.made_diameter_nm(resist / nm, _isolation(pillars, process))
    top, foot = process.top_foot_nm(0.0, height_um / nm)
    return Certificate(
        pillars.x_um,
        pillars.y_um,
        (pillars.size_um / nm).astype(np.float32)[pillars.kind],
        (resist / nm).astype(np.float32),
        made.astype(np.float32),
        exposure.astype(np.float32) / np.float32(THRESHOLD),
        pillars.layer.astype(np.uint16)[pillars.kind],
        (pillars.layer != process.layers.dose[0])[pillars.kind],
        _edges(points, others, of_edges, terms),
        float(foot - top) / 2,
        undosed,
    )


def _terms(process: Process) -> Terms:
    """(range, weight) of the Gaussians, weights of sum 1."""
    e = process.exposure
    if e.alpha_um is None or e.beta_um is None or e.eta is None:
        raise ProcessError(f"the exposure cannot be certified: [exposure] needs {e.missing}")
    found = [(e.alpha_um, 1.0), (e.beta_um, e.eta)] + ([] if e.gamma_um is None else [(e.gamma_um, e.nu)])
    total = sum(weight for _, weight in found)
    return [(range_um, weight / total) for range_um, weight in found]


def _background(pillars: Pillars, others: Polygons, at_um: Array, terms: Terms) -> tuple[Array, Array]:
    """Exposure of each pillar's rim by everything else, and of the points by the wide Gaussians of everything."""
    carried = pillars.area_um2 * pillars.dose
    mass = carried[pillars.kind]
    far, of_points = np.zeros(len(mass)), np.zeros(len(at_um))
    for range_um, weight in terms:
        if range_um >= _WIDE_UM:
            x, y, more = outlines.spots(others, range_um / 8)
            from_x, from_y = np.concatenate([pillars.x_um, x]), np.concatenate([pillars.y_um, y])
            at = np.concatenate([pillars.x_um, at_um[:, 0]]), np.concatenate([pillars.y_um, at_um[:, 1]])
            found = weight * background.wide(from_x, from_y, np.concatenate([mass, more]), at, range_um)
            far += found[: len(mass)] - weight / (np.pi * range_um**2) * mass
            of_points += found[len(mass) :]
        elif range_um > 0.05 * float(pillars.size_um.max()):
            radius = (pillars.size_um / 2)[pillars.kind]
            far += weight * background.beside(pillars.x_um, pillars.y_um, mass, radius, range_um)
    return far, of_points


def _isolation(pillars: Pillars, process: Process) -> Array | float:
    """How alone each pillar stands: what its neighbours lack of the densest place's, weighed by exp(-r^2 / range^2)."""
    range_um = process.bias.range_um
    if not process.bias.isolated_nm:
        return 0.0
    one = np.ones(len(pillars.kind))
    at = pillars.x_um, pillars.y_um
    near = np.pi * range_um**2 * background.wide(*at, one, at, range_um) - 1  # less itself
    full = float(np.quantile(near, 0.999))
    return np.clip(1 - near / full, 0, 1) if full > 0 else one


def _developed(pillars: Pillars, far: Array, terms: Terms) -> tuple[Array, Array]:
    """(n,) exposure of the drawn edge, and diameter at which the exposure is the threshold, um."""
    sizes, which = np.unique(pillars.size_um, return_inverse=True)
    tables = [_profile(size, terms) for size in sizes.tolist()]
    radius, own = (np.array([table[k] for table in tables]) for k in (0, 1))
    exposure, made = np.empty(len(far)), np.empty(len(far))
    _develop(pillars.kind, which.astype(np.int64), pillars.dose, far, radius, own, THRESHOLD, exposure, made)
    return exposure, made


@compiled
def _develop(
    kind: Array,
    size: Array,
    dose: Array,
    far: Array,
    radius: Array,
    own: Array,
    threshold: float,
    exposure: Array,
    made: Array,
) -> None:
    """Interpolate in the falling ``own`` (sizes, levels); the drawn edge is its middle level."""
    last = own.shape[1] - 1
    for n in range(kind.shape[0]):
        s, given = size[kind[n]], dose[kind[n]]
        exposure[n] = given * own[s, last // 2] + far[n]
        wanted = (threshold - far[n]) / given
        low, high = 0, last
        while high - low > 1:
            middle = (low + high) // 2
            if own[s, middle] > wanted:
                low = middle
            else:
                high = middle
        fall = own[s, low] - own[s, high]
        share = min(max((own[s, low] - wanted) / fall, 0.0), 1.0) if fall > 0 else 0.0
        made[n] = 2 * (radius[s, low] + share * (radius[s, high] - radius[s, low]))


def _profile(size_um: float, terms: Terms) -> tuple[Array, Array]:
    """(radii, exposure) of a disc of unit dose about its edge: the non-central chi-square of two degrees."""
    from scipy.special import chndtr

    core = min(a for a, _ in terms)
    span = min(size_um / 2 * 0.9, 4 * core)
    radius = np.linspace(size_um / 2 - span, size_um / 2 + span, 2 * _LEVELS + 1)
    own = sum(w * chndtr(2 * (size_um / 2 / a) ** 2, 2.0, 2 * (radius / a) ** 2) for a, w in terms)
    return radius, np.asarray(own)


def _edges(points: outlines.Samples, others: Polygons, far: Array, terms: Terms) -> Edges:
    """Exposure at the samples, and where across each edge it is the threshold."""
    near = [(a, w) for a, w in terms if a < _WIDE_UM]
    every = np.concatenate([points.at_um, *outlines.slope_aside(points)])
    here, outside, inside = np.split(outlines.exposure(every, others, near), 3)
    here = here + far
    slope = np.maximum(inside - outside, 1e-12) / outlines.aside_um()
    x, y = points.at_um.T
    return Edges(x, y, here / THRESHOLD, (here - THRESHOLD) / slope / nm, points.layer)
