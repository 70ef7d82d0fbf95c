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

# least share of rays whose edges lie on one circle; half on a bar of aspect ratio 2
_ROUND = 2 / 3
# sites that test a candidate lattice, and discs that give the blur of a picture
_TRIED = 25
# radius over blur above which a disc's own blur replaces the median of the picture
_TELLS = 3.0
# share of sites that decides about a lattice or a picture
MOST = 0.5
# length over width above which a pillar counts as oval: a circle's radius is off by
# 0.4 % there
_OVAL = 1.15
# standard errors of narrow discs (7 to 12 pixels, noise 0.1) over those of edges alone
_LEVELS = 1.2
# error of the blur's effect on a radius, as a share of it: clean discs (7 to 30 pixels,
# blur 0.5 to 2.5)
_UNSURE = 0.1


@dataclass(frozen=True, slots=True)
class SemMicrograph:
    """Scale of a micrograph.

    pixel_nm: size of a pixel. pitch_nm: lattice constant of the pillars, 0 if unknown.
    edge_bias_nm: distance of the imaged edges outside the true ones, from a calibration
    sample.
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
    """Pillars measured in a micrograph.

    row, column: (p,) centres in pixels.
    diameter_nm: (p,) nan where the pillar is missing, collapsed or oval.
    sigma_nm: (p,) standard error of each diameter: noise of edges, rim and gap, and a
    tenth of the correction for blur. A bright rim adds a constant (edge_bias_nm).
    missing: (p,) no pillar at the site. collapsed: (p,) off its site, or not round.
    oval: (p,) longer than wide by more than 15 %, beyond noise; not measured.
    site: (p, 2) lattice index j and i. lattice: places of the sites in pixels.
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
        """Whether most sites hold no round pillar, so that the lattice may be wrong."""
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
        """Mean diameter error against the design as the known value ``bias_nm`` of a
        fit, with its standard error.

        Args:
            designed_nm: (p,) drawn diameters, or one for all.
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


def measure_diameters(image: Array, about: SemMicrograph) -> MeasuredDiameters:
    """Diameters of all pillars on the lattice of a top-down micrograph.

    Rims must be brighter than the gaps. Where most sites hold no round pillar, lattices
    shifted by half a cell are tried too: pillars with dark tops.

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
    first_pass = _levelled(picture, pitch or min(picture.shape) / 4)
    lattice = find_lattice(first_pass, pitch)
    flat = _levelled(picture, lattice.pitch_px) if pitch is None else first_pass
    measured = _measure_on_lattice(flat, lattice, about)
    if not measured.doubtful:
        return measured
    candidates = [
        candidate
        for candidate in _shifted_lattices(lattice)
        if len(candidate.sites(flat.shape)[0])
    ]
    whole_shares = [
        _measure_on_lattice(flat, candidate, about, sample=_TRIED).whole
        for candidate in candidates
    ]
    return (
        _measure_on_lattice(flat, candidates[int(np.argmax(whole_shares))], about)
        if max(whole_shares, default=0.0) > MOST
        else measured
    )


def _shifted_lattices(lattice: ImageLattice) -> list[ImageLattice]:
    """The lattice shifted by half of a + b, of a and of b."""
    a, b = lattice.a / 2, lattice.b / 2
    return [
        dataclasses.replace(lattice, origin=lattice.origin + step)
        for step in (a + b, a, b)
    ]


def _measure_on_lattice(
    flat: Array, lattice: ImageLattice, about: SemMicrograph, *, sample: int = 0
) -> MeasuredDiameters:
    """Pillars at the sites of a lattice in a levelled picture.

    Args:
        flat: (y, x) levelled picture.
        lattice: the sites.
        about: pixel size and edge bias.
        sample: number of sites to measure, evenly from all; 0 for all.
    """
    places, site = (
        values[:: max(len(values) // sample, 1) if sample else 1]
        for values in lattice.sites(flat.shape)
    )
    steps = [_edge_step(flat, row, column, lattice.pitch_px) for row, column in places]
    median_step = float(np.median(steps)) if steps else 0.0
    results = [
        _pillar(
            flat, row, column, lattice.pitch_px, is_present=step > 0.4 * median_step
        )
        for (row, column), step in zip(places, steps, strict=True)
    ]
    if not results:
        raise CaptureError("no whole pillar in the picture; need a wider picture")
    row, column, radius, sigma, missing, collapsed = (
        np.array(values) for values in zip(*results, strict=True)
    )
    raw_radius = np.where(collapsed.astype(bool), np.nan, radius)
    radius, sigma = _deblurred_radii(
        flat, np.stack([row, column], 1), raw_radius, sigma, lattice.pitch_px
    )
    diameter = 2 * radius * about.pixel_nm - 2 * about.edge_bias_nm
    missing = missing.astype(bool)
    collapsed = collapsed.astype(bool)
    on_site = ~missing & (
        np.hypot(*(np.stack([row, column], 1) - places).T) < 0.2 * lattice.pitch_px
    )
    oval = np.array(
        [
            is_on_site and _is_oval(flat, y, x, lattice.pitch_px)
            for is_on_site, y, x in zip(on_site, row, column, strict=True)
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


def _levelled(image: Array, pitch: float) -> Array:
    """(y, x) picture less its slow background along rows and in 2D; its 10th and 90th
    percentile become 0 and 1.
    """
    row_level = ndimage.gaussian_filter1d(np.median(image, axis=1), 2 * pitch)
    flat = image - row_level[:, None]
    flat = flat - ndimage.gaussian_filter(flat, 1.5 * pitch)
    low, high = np.percentile(flat, [10, 90])
    return np.asarray((flat - low) / max(high - low, 1e-12))


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
    """Levels along rays from a point.

    Returns:
        (r,) distances in pixels, (rays,) angles in rad, (r, rays) levels, smoothed
        along and across the rays.
    """
    angle = (np.arange(RAYS) + 0.5) * 2 * math.pi / RAYS
    step_px = min(0.25, pitch / 120)
    distance = np.arange(0, 0.5 * pitch + 1, step_px)
    indices = (
        row + distance[:, None] * np.sin(angle),
        column + distance[:, None] * np.cos(angle),
    )
    rays = ndimage.map_coordinates(flat, indices, order=1, mode="nearest")
    sigma_px = radial.ray_smoothing(pitch) / step_px
    return (
        distance,
        angle,
        ndimage.gaussian_filter(rays, (sigma_px, 1.0), mode=("nearest", "wrap")),
    )


def _deblurred_radii(
    flat: Array, place: Array, radius: Array, sigma: Array, pitch: float
) -> tuple[Array, Array]:
    """Radii and standard errors in pixels, with narrow discs corrected for blur.

    The blur is the median variance of ``_TRIED`` or more discs. A disc wider than
    ``_TELLS`` blurs takes its own, which cancels noise of its rim and gap levels.

    Args:
        flat: (y, x) levelled picture.
        place: (p, 2) row and column of the pillars.
        radius: (p,) radii; nan where not measured.
        sigma: (p,) standard errors.
        pitch: lattice constant, pixels.
    """
    radius = radius.copy()
    sigma = sigma.copy()
    smooth = radial.ray_smoothing(pitch)

    def blur_at(k: int) -> float:
        reach, _, rays = _rays(flat, place[k, 0], place[k, 1], pitch)
        return radial.blur_variance(reach, rays, smooth)

    measured = np.flatnonzero(np.isfinite(radius)).tolist()
    own_variance = {k: blur_at(k) for k in measured[:: max(len(measured) // _TRIED, 1)]}
    variances = np.array(list(own_variance.values()))
    if np.isfinite(variances).sum() <= MOST * len(variances):
        return radius, sigma
    median_variance = float(np.nanmedian(variances))
    for k in measured:
        variance_used = median_variance
        if radial.is_wide_disc(radius[k], median_variance, smooth, times=_TELLS):
            variance = own_variance[k] if k in own_variance else blur_at(k)
            variance_used = variance if math.isfinite(variance) else median_variance
        circle = _fit_circle(flat, place[k, 0], place[k, 1], pitch, variance_used)
        if circle is not None and math.isfinite(circle[2]):
            radius[k], sigma[k] = circle[2:4]
    return radius, sigma


def _edge_step(flat: Array, row: float, column: float, pitch: float) -> float:
    """Level of a pillar's rim less that of the gap, from the mean over all rays."""
    distance, _, rays = _rays(flat, row, column, pitch)
    inner, outer, _ = radial.rim_and_gap_levels(distance, rays)
    return inner - outer


def _pillar(
    flat: Array, row: float, column: float, pitch: float, *, is_present: bool
) -> tuple[float, float, float, float, bool, bool]:
    """(row, column, radius, standard error, missing, collapsed) of the pillar at a
    lattice site, in pixels.

    The circle is fitted up to four times about its new middle.

    Args:
        row: site. column: site.
        pitch: lattice constant.
        is_present: whether the site shows an edge; without, a bright patch in its cell
            means a fallen pillar.
    """
    half = int(pitch / 2)
    row_px = int(round(row))
    column_px = int(round(column))
    patch = flat[
        max(row_px - half, 0) : row_px + half + 1,
        max(column_px - half, 0) : column_px + half + 1,
    ]
    if not is_present:
        is_fallen = bool(
            (ndimage.uniform_filter(patch, 5) > 0.6).mean() > 0.08
        )  # it lies elsewhere in its cell
        return row, column, math.nan, math.nan, not is_fallen, is_fallen
    y = row
    x = column
    radius = math.nan
    sigma = math.nan
    scatter = math.inf
    for _ in range(4):
        circle = _fit_circle(flat, y, x, pitch)
        if circle is None:
            return y, x, math.nan, math.nan, False, True
        dy, dx, radius, sigma, scatter = circle
        y, x = y + dy, x + dx
        if math.hypot(dy, dx) < 1e-3:
            break
    is_displaced = math.hypot(y - row, x - column) > 0.2 * pitch
    return (
        y,
        x,
        radius,
        sigma,
        False,
        bool(is_displaced or scatter > max(0.15 * radius, 1.5)),
    )


def _fit_circle(
    flat: Array, row: float, column: float, pitch: float, blur: float | None = None
) -> tuple[float, float, float, float, float] | None:
    """Circle fitted to the half-level crossings of all rays: (dy, dx, radius, standard
    error, scatter) in pixels; None without edges.

    Edges are r(t) = R + dy sin t + dx cos t + S sin 2t + C cos 2t. The radius is that
    of equal area, corrected for blur. The scatter is about the circle alone, infinite
    where too many rays have their edges off it.

    Args:
        flat: (y, x) levelled picture.
        row: middle to start from. column: likewise.
        pitch: lattice constant, pixels.
        blur: variance of the blur, square pixels, for a disc that is not wide; None
            takes the steepness of the edges.
    """
    distance, angle, rays = _rays(flat, row, column, pitch)
    inner, outer, rim = radial.rim_and_gap_levels(distance, rays)
    edge_px = radial.edge_crossings(distance, rays, (inner + outer) / 2, rim)
    valid = np.isfinite(edge_px)
    if inner - outer < 0.2 or valid.sum() < RAYS // 2:
        return None
    middle = np.median(edge_px[valid])
    valid &= np.abs(edge_px - middle) < max(0.2 * middle, 2.0)
    terms = np.stack(
        [
            np.ones(RAYS),
            *(function(k * angle) for k in (1, 2) for function in (np.sin, np.cos)),
        ],
        1,
    )
    design = terms[valid]
    (mean, dy, dx, *oval), *_ = np.linalg.lstsq(design, edge_px[valid], rcond=None)
    residual = edge_px[valid] - design @ np.array([mean, dy, dx, *oval])
    oval_variance = 0.5 * float(
        np.square(oval).sum()
    )  # mean square of the second harmonic
    independent = _independent_rays(mean)
    edge_variance = residual.var() / max(
        1 - len(terms[0]) / (independent * valid.mean()), 0.1
    )  # of an edge; the terms took some
    variance_factor = (
        float(np.linalg.pinv(design.T @ design)[0, 0]) * RAYS / independent
    )
    # half of the rim's level and half of the gap's, as noisy as edges, are in every
    # edge
    level_factor = 0.25 / _independent_rays(
        float(distance[rim])
    ) + 0.25 / _independent_rays(0.5 * (mean + 0.5 * pitch))
    fitted_px = terms @ np.array([mean, dy, dx, *oval])
    radius = math.sqrt(mean**2 + oval_variance)
    smooth = radial.ray_smoothing(pitch)
    noise = math.sqrt(edge_variance * (variance_factor + level_factor))
    blur_loss = radial.drawn_in(distance, rays, fitted_px, radius, smooth)
    corrected = radius + blur_loss
    systematic = _UNSURE * blur_loss
    if blur is not None and not radial.is_wide_disc(radius, blur, smooth):
        (corrected, gain), plain = (
            radial.deblur_radius(distance, radius, blur, smooth),
            blur / (2 * radius),
        )
        noise = noise * gain * _LEVELS
        systematic = _UNSURE * (plain + abs(corrected - radius - plain))
    error = math.hypot(noise, systematic)
    scatter = (
        math.sqrt(residual.var() + oval_variance) if valid.mean() > _ROUND else math.inf
    )
    return float(dy), float(dx), corrected, error, scatter


def _is_oval(flat: Array, row: float, column: float, pitch: float) -> bool:
    """Whether a pillar is longer than wide by more than ``_OVAL``, beyond four standard
    errors.

    An ellipse of half axes a, b is 1 / r² = A + B cos 2t + C sin 2t, with a² / b² =
    (A + D) / (A - D), D² = B² + C². The edge of a ray is its steepest fall.
    """
    distance, angle, rays = _rays(flat, row, column, pitch)
    start = int(np.searchsorted(distance, 0.1 * pitch))
    edge_px = distance[start + np.argmin(np.diff(rays[start:], axis=0), axis=0)]
    design = np.stack(
        [np.ones(RAYS), *(f(k * angle) for k in (1, 2) for f in (np.cos, np.sin))], 1
    )
    valid = np.ones(RAYS, bool)
    for _ in range(4):
        powers = np.linalg.lstsq(design[valid], edge_px[valid] ** -2, rcond=None)[0]
        fitted = np.maximum(design @ powers, 1e-12) ** -0.5
        residual = edge_px - fitted
        valid = np.abs(residual) < max(0.2 * float(np.median(edge_px)), 2.0)
        if valid.sum() < _ROUND * RAYS or powers[0] <= 0:
            return False
    level = float(powers[0])
    second_harmonic = math.hypot(*powers[3:])
    degrees = max(_independent_rays(level**-0.5) * valid.mean() - 5, 1.0)
    noise = float((residual[valid] * 2 * fitted[valid] ** -3).std()) * math.sqrt(
        2 / degrees
    )
    return second_harmonic > 4 * noise and level + second_harmonic > _OVAL**2 * (
        level - second_harmonic
    )


def _independent_rays(radius: float) -> float:
    """Number of statistically independent rays at a radius in pixels.

    Noise of single pixels is smoothed over rays (a Gaussian of one ray) and by
    interpolation between pixels (a variance of 1/6).
    """
    step = 2 * math.pi * max(radius, 0.5) / RAYS
    return RAYS / (2 * math.sqrt(math.pi) * math.sqrt(1 + 1 / (6 * step**2)))
