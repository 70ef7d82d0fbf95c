"""Electron micrographs to pillar diameters: radial edges to a fraction of a pixel,
missing and collapsed pillars.
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from characterize.measure import radial
from characterize.measure.lattice import ImageLattice, find_lattice
from characterize.measure.radial import RAYS
from characterize.model import KnownValue
from metalens.core.arrays import Array
from metalens.core.errors import DAMAGE, CaptureError

_ROUND = (
    2 / 3
)  # share of rays whose edges lie on one circle: of a bar twice as long as wide a half do
# sites of a lattice that is only tried, discs that tell the blur of a picture
_TRIED = 25
# radius over blur from which on a disc tells its blur as well as all together do
_TELLS = 3.0
# share of sites above which what is there decides of a lattice, or of a picture
MOST = 0.5
# length over width from which on a pillar is none of round ones: a circle's radius is
# off by 0.4 % there
_OVAL = 1.15
# errors of narrow discs (7 to 12 pixels, noise of a tenth) over those of edges: their
# tops are one place
_LEVELS = 1.2
# share of what blur does to a radius by which clean discs (7 to 30 pixels, blur 0.5 to
# 2.5) are off
_UNSURE = 0.1


@dataclass(frozen=True, slots=True)
class Micrograph:
    """What is known of a picture.

    pixel_nm: size of a pixel. pitch_nm: lattice constant of the pillars.
    edge_bias_nm: constant by which edges appear outside (above 0) the true ones, from a
    calibration sample.
    """

    pixel_nm: float
    pitch_nm: float = 0.0
    edge_bias_nm: float = 0.0

    def __post_init__(self) -> None:
        known = self.pitch_nm >= 6 * self.pixel_nm or self.pitch_nm == 0
        if not (self.pixel_nm > 0 and known):
            raise CaptureError(
                f"pixel_nm {self.pixel_nm}, pitch_nm {self.pitch_nm}: need 6 or more pixels in a pitch"
            )


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredDiameters:
    """Pillars found in a micrograph.

    row, column: (p,) centres in pixels. diameter_nm: (p,) nan where the pillar is
    missing or collapsed.
    sigma_nm: (p,) standard error of each diameter: noise of its edges, rim and gap, and
    a tenth of what blur did. It
        holds 95 % of drawn discs without a bright rim; a rim adds a constant
        (edge_bias_nm).
    missing, collapsed: (p,) no pillar at a lattice site; a pillar off its site or far
    from round.
    oval: (p,) longer than wide by more than 15 %, beyond noise; not measured.
    site: (p, 2) lattice index j and i of each; lattice: where the sites are, in pixels.
    """

    row: Array
    column: Array
    diameter_nm: Array
    sigma_nm: Array
    missing: Array
    collapsed: Array
    site: Array
    lattice: ImageLattice
    oval: Array

    @property
    def _good_nm(self) -> Array:
        return np.asarray(self.diameter_nm[np.isfinite(self.diameter_nm)])

    @property
    def doubtful(self) -> bool:
        """Whether most sites hold what is no round pillar: then the lattice may be
        another.
        """
        return bool(self.collapsed.mean() > MOST)

    @property
    def whole(self) -> float:
        """Share of sites that hold a pillar, round or oval."""
        return float(1 - (self.missing | self.collapsed).mean())

    @property
    def mean_nm(self) -> float:
        """Mean diameter of the good pillars; nan without one."""
        return float(self._good_nm.mean()) if self._good_nm.size else math.nan

    @property
    def three_sigma_nm(self) -> float:
        """Three standard deviations of the good pillars (CD uniformity); nan without
        one.
        """
        return float(3 * self._good_nm.std()) if self._good_nm.size else math.nan

    def bias(self, designed_nm: Array | float) -> KnownValue:
        """Mean difference to the design as prior knowledge for a fit: ``bias_nm`` with
        its standard error.
        """
        difference = self.diameter_nm - np.asarray(designed_nm)
        good = difference[np.isfinite(difference)]
        if len(good) < 3:
            raise CaptureError(
                f"{len(good)} good pillars: need three or more for a bias"
            )
        return KnownValue(
            "bias_nm",
            float(good.mean()),
            float(max(good.std(ddof=1) / math.sqrt(len(good)), 0.05)),
        )


def measure_diameters(image: Array, about: Micrograph) -> MeasuredDiameters:
    """Diameters of all whole pillars on the lattice of a top-down micrograph, rims
    brighter than the gaps.

    Args:
        image: (y, x) picture.
        about: pixel, pitch and edge bias of the picture.

    Raises:
        CaptureError: no lattice (of the stated pitch), or no picture of one channel.
    """
    picture = np.asarray(image, float)
    if picture.ndim != 2 or not np.isfinite(picture).all():
        raise CaptureError(
            f"micrograph of shape {picture.shape}: need one grey picture (y, x) of finite values"
        )
    pitch = about.pitch_nm / about.pixel_nm if about.pitch_nm else None
    rough = _flattened(picture, pitch or min(picture.shape) / 4)
    lattice = find_lattice(rough, pitch)
    flat = _flattened(picture, lattice.pitch_px) if pitch is None else rough
    found = _on(flat, lattice, about)
    if (
        not found.doubtful
    ):  # the brightest places of a cell are its pillars, but for dark tops
        return found
    others = [one for one in _others(lattice) if len(one.sites(flat.shape)[0])]
    tried = [_on(flat, one, about, most=_TRIED).whole for one in others]
    return (
        _on(flat, others[int(np.argmax(tried))], about)
        if max(tried, default=0.0) > MOST
        else found
    )


def _others(lattice: ImageLattice) -> list[ImageLattice]:
    """The same lattice with pillars where its gaps are."""
    a, b = lattice.a / 2, lattice.b / 2
    return [
        dataclasses.replace(lattice, origin=lattice.origin + step)
        for step in (a + b, a, b)
    ]


def _on(
    flat: Array, lattice: ImageLattice, about: Micrograph, *, most: int = 0
) -> MeasuredDiameters:
    """Pillars on a lattice that is known, in a levelled picture; of some ``most``
    sites, evenly from all, if stated.
    """
    place, site = (
        v[:: max(len(v) // most, 1) if most else 1] for v in lattice.sites(flat.shape)
    )
    steps = [_step(flat, row, column, lattice.pitch_px) for row, column in place]
    usual = float(np.median(steps)) if steps else 0.0
    results = [
        _pillar(flat, row, column, lattice.pitch_px, there=step > 0.4 * usual)
        for (row, column), step in zip(place, steps, strict=True)
    ]
    if not results:
        raise CaptureError("no whole pillar in the picture; need a wider picture")
    row, column, radius, sigma, missing, collapsed = (
        np.array(v) for v in zip(*results, strict=True)
    )
    whole = np.where(collapsed.astype(bool), np.nan, radius)
    radius, sigma = _sharper(
        flat, np.stack([row, column], 1), whole, sigma, lattice.pitch_px
    )
    diameter = 2 * radius * about.pixel_nm - 2 * about.edge_bias_nm
    missing, collapsed = missing.astype(bool), collapsed.astype(bool)
    near = ~missing & (
        np.hypot(*(np.stack([row, column], 1) - place).T) < 0.2 * lattice.pitch_px
    )
    oval = np.array(
        [
            n and _is_oval(flat, y, x, lattice.pitch_px)
            for n, y, x in zip(near, row, column, strict=True)
        ]
    )
    collapsed = collapsed & ~oval
    diameter = np.where(missing | collapsed | oval, np.nan, diameter)
    return MeasuredDiameters(
        row,
        column,
        diameter,
        2 * sigma * about.pixel_nm,
        missing,
        collapsed,
        site,
        lattice,
        oval,
    )


def _flattened(image: Array, pitch: float) -> Array:
    rows = ndimage.gaussian_filter1d(np.median(image, axis=1), 2 * pitch)
    steady = image - rows[:, None]
    steady = steady - ndimage.gaussian_filter(steady, 1.5 * pitch)
    low, high = np.percentile(steady, [10, 90])
    return np.asarray((steady - low) / max(high - low, 1e-12))


def instrument_pixel_nm(path: Path) -> float | None:
    """Pixel size of a micrograph in nm, from the instrument's own TIFF tags.

    Read are Zeiss SmartSEM (tag 34118, ``AP_PIXEL_SIZE``) and FEI / Thermo Fisher
    (tags 34680 and 34682, ``PixelWidth`` of ``[Scan]``, m).

    Args:
        path: the file.

    Returns:
        None for other files.

    Raises:
        CaptureError: pixels that are not square, or a size that is no length above 0.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            zeiss = file.sem_metadata or {}
            fei = file.fei_metadata or {}
    except DAMAGE:
        return None
    sizes: list[float] = []
    if "ap_pixel_size" in zeiss:
        _, value, unit = zeiss["ap_pixel_size"]
        scale = {"pm": 1e-3, "nm": 1.0, "um": 1e3, "\xb5m": 1e3}.get(unit)
        sizes = [value * scale] if scale else []
    elif "PixelWidth" in fei.get("Scan", {}):
        scan = fei["Scan"]
        sizes = [scan[k] * 1e9 for k in ("PixelWidth", "PixelHeight") if k in scan]
    if not sizes:
        return None
    if not 0 < max(sizes) < 1.01 * min(sizes):
        raise CaptureError(
            f"{path}: pixels of {sizes} nm by the instrument's tag; need square ones: "
            "give --pixel-nm"
        )
    return sizes[0]


def scale_from_bar(image: Array, bar_nm: float) -> float:
    """pixel_nm from a scale bar: the longest run of saturated pixels in a row of the
    lowest quarter.

    Args:
        image: (y, x) picture.
        bar_nm: length of the scale bar, nm.

    Raises:
        CaptureError: no bar of at least 20 pixels.
    """
    strip = np.asarray(image)[-max(len(image) // 4, 1) :]
    bright = strip >= strip.max()
    longest = 0
    for line in bright:
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        longest = max(longest, int((edges[1::2] - edges[::2]).max(initial=0)))
    if longest < 20:
        raise CaptureError(
            f"no scale bar: longest bright run is {longest} pixels; give pixel_nm instead"
        )
    return bar_nm / longest


def _rays(
    flat: Array, row: float, column: float, pitch: float
) -> tuple[Array, Array, Array]:
    """(distance, angle, (distance, angle) levels smoothed along and across) about a
    place.
    """
    angle = (np.arange(RAYS) + 0.5) * 2 * math.pi / RAYS
    fine = min(0.25, pitch / 120)
    reach = np.arange(0, 0.5 * pitch + 1, fine)
    points = (
        row + reach[:, None] * np.sin(angle),
        column + reach[:, None] * np.cos(angle),
    )
    rays = ndimage.map_coordinates(flat, points, order=1, mode="nearest")
    smooth = radial.ray_smoothing(pitch) / fine
    return (
        reach,
        angle,
        ndimage.gaussian_filter(rays, (smooth, 1.0), mode=("nearest", "wrap")),
    )


def _sharper(
    flat: Array, place: Array, radius: Array, sigma: Array, pitch: float
) -> tuple[Array, Array]:
    """Radii and their errors, those of solid discs that are not wide beside the blur
    found anew.

    Blur is one of the picture: the median over ``_TRIED`` discs or a few more. A disc
    wider than a few blurs tells its
    own, whose noise offsets that of the levels of its rim and gap.
    """
    radius = radius.copy()
    sigma = sigma.copy()
    smooth = radial.ray_smoothing(pitch)

    def own_blur(k: int) -> float:
        reach, _, rays = _rays(flat, place[k, 0], place[k, 1], pitch)
        return radial.blur_variance(reach, rays, smooth)

    there = np.flatnonzero(np.isfinite(radius)).tolist()
    own = {k: own_blur(k) for k in there[:: max(len(there) // _TRIED, 1)]}
    blurs = np.array(list(own.values()))
    if np.isfinite(blurs).sum() <= MOST * len(blurs):
        return radius, sigma
    usual = float(np.nanmedian(blurs))
    for k in there:
        blur = usual
        if radial.is_wide_disc(radius[k], usual, smooth, times=_TELLS):
            mine = own[k] if k in own else own_blur(k)
            blur = mine if math.isfinite(mine) else usual
        found = _edges(flat, place[k, 0], place[k, 1], pitch, blur)
        if found is not None and math.isfinite(found[2]):
            radius[k], sigma[k] = found[2:4]
    return radius, sigma


def _step(flat: Array, row: float, column: float, pitch: float) -> float:
    """Height of the fall from a pillar's rim to the gap, in the mean over all rays."""
    reach, _, rays = _rays(flat, row, column, pitch)
    inner, outer, _ = radial.rim_and_gap_levels(reach, rays)
    return inner - outer


def _pillar(
    flat: Array, row: float, column: float, pitch: float, *, there: bool
) -> tuple[float, float, float, float, bool, bool]:
    """(row, column, radius, its error, missing, collapsed) at a lattice site, in
    pixels.
    """
    half = int(pitch / 2)
    r0, c0 = int(round(row)), int(round(column))
    patch = flat[max(r0 - half, 0) : r0 + half + 1, max(c0 - half, 0) : c0 + half + 1]
    if not there:
        fallen = bool(
            (ndimage.uniform_filter(patch, 5) > 0.6).mean() > 0.08
        )  # it lies elsewhere in its cell
        return row, column, math.nan, math.nan, not fallen, fallen
    y = row
    x = column
    radius = math.nan
    sigma = math.nan
    scatter = math.inf
    for _ in range(4):
        edges = _edges(flat, y, x, pitch)
        if edges is None:
            return y, x, math.nan, math.nan, False, True
        dy, dx, radius, sigma, scatter = edges
        y, x = y + dy, x + dx
        if math.hypot(dy, dx) < 1e-3:
            break
    off = math.hypot(y - row, x - column) > 0.2 * pitch
    return y, x, radius, sigma, False, bool(off or scatter > max(0.15 * radius, 1.5))


def _edges(
    flat: Array, row: float, column: float, pitch: float, blur: float | None = None
) -> tuple[float, float, float, float, float] | None:
    """Disc through the half-rise places of all rays: (dy, dx, radius, error of it,
    scatter); None without edges.

    Edges are r(t) = R + dy sin t + dx cos t + S sin 2t + C cos 2t; the radius is that
    of the same area, less what blur
    takes; with the variance of a ``blur`` that is known, less what that does to a solid
    disc which is not wide beside
    it. The scatter is about the circle alone, and infinite where too many rays have
    their edges elsewhere.
    """
    reach, angle, rays = _rays(flat, row, column, pitch)
    inner, outer, rim = radial.rim_and_gap_levels(reach, rays)
    found = radial.edge_crossings(reach, rays, (inner + outer) / 2, rim)
    good = np.isfinite(found)
    if inner - outer < 0.2 or good.sum() < RAYS // 2:
        return None
    middle = np.median(found[good])
    good &= np.abs(found - middle) < max(0.2 * middle, 2.0)
    terms = np.stack(
        [np.ones(RAYS), *(f(k * angle) for k in (1, 2) for f in (np.sin, np.cos))], 1
    )
    design = terms[good]
    (mean, dy, dx, *oval), *_ = np.linalg.lstsq(design, found[good], rcond=None)
    rest = found[good] - design @ np.array([mean, dy, dx, *oval])
    wide = 0.5 * float(np.square(oval).sum())  # mean square of what is oval
    independent = _independent(mean)
    noise = rest.var() / max(
        1 - len(terms[0]) / (independent * good.mean()), 0.1
    )  # of an edge; the terms took some
    own = float(np.linalg.pinv(design.T @ design)[0, 0]) * RAYS / independent
    # half of the rim's level and half of the gap's, as noisy as edges, are in every
    # edge
    shared = 0.25 / _independent(float(reach[rim])) + 0.25 / _independent(
        0.5 * (mean + 0.5 * pitch)
    )
    edge = terms @ np.array([mean, dy, dx, *oval])
    radius = math.sqrt(mean**2 + wide)
    smooth = radial.ray_smoothing(pitch)
    noise = math.sqrt(noise * (own + shared))
    taken = radial.drawn_in(reach, rays, edge, radius, smooth)
    true, unsure = radius + taken, _UNSURE * taken
    if blur is not None and not radial.is_wide_disc(radius, blur, smooth):
        (true, gain), plain = (
            radial.deblur_radius(reach, radius, blur, smooth),
            blur / (2 * radius),
        )
        noise = noise * gain * _LEVELS
        unsure = _UNSURE * (plain + abs(true - radius - plain))
    error = math.hypot(noise, unsure)
    scatter = math.sqrt(rest.var() + wide) if good.mean() > _ROUND else math.inf
    return float(dy), float(dx), true, error, scatter


def _is_oval(flat: Array, row: float, column: float, pitch: float) -> bool:
    """Whether a pillar is longer than wide by more than ``_OVAL``, and by four sigma of
    its edges' scatter.

    About its middle an ellipse of half axes a, b is 1 / r² = A + B cos 2t + C sin 2t,
    of a² / b² = (A + D) / (A - D),
    D² = B² + C². Edges are where each ray falls the most: levels of the mean over all
    rays are of no ray's own.
    """
    reach, angle, rays = _rays(flat, row, column, pitch)
    first = int(np.searchsorted(reach, 0.1 * pitch))
    edge = reach[first + np.argmin(np.diff(rays[first:], axis=0), axis=0)]
    design = np.stack(
        [np.ones(RAYS), *(f(k * angle) for k in (1, 2) for f in (np.cos, np.sin))], 1
    )
    good = np.ones(RAYS, bool)
    for _ in range(4):
        powers = np.linalg.lstsq(design[good], edge[good] ** -2, rcond=None)[0]
        fitted = np.maximum(design @ powers, 1e-12) ** -0.5
        rest = edge - fitted
        good = np.abs(rest) < max(0.2 * float(np.median(edge)), 2.0)
        if good.sum() < _ROUND * RAYS or powers[0] <= 0:
            return False
    level, along = float(powers[0]), math.hypot(*powers[3:])
    own = max(_independent(level**-0.5) * good.mean() - 5, 1.0)
    noise = float((rest[good] * 2 * fitted[good] ** -3).std()) * math.sqrt(2 / own)
    return along > 4 * noise and level + along > _OVAL**2 * (level - along)


def _independent(radius: float) -> float:
    """How many of the rays at a radius in pixels tell something of their own, the
    circle's three numbers among them.

    Noise of single pixels, smoothed over rays (a Gaussian of one ray) and between
    pixels (a variance of 1/6 across).
    """
    step = 2 * math.pi * max(radius, 0.5) / RAYS
    return RAYS / (2 * math.sqrt(math.pi) * math.sqrt(1 + 1 / (6 * step**2)))
