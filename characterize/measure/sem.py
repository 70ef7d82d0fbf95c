"""Electron micrographs to pillar diameters, by blurred discs fitted to the pixels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import integrate, ndimage, special

from characterize.measure.lattice import ImageLattice, find_lattice
from characterize.model import KnownValue
from metalens.core.arrays import Array
from metalens.core.errors import DAMAGE, CaptureError

# share of sites that decides about a picture
MOST = 0.5
# length over width above which a pillar counts as oval: a circle's radius is off by
# 0.4 % there
_OVAL = 1.15
# displacement from its site, over the pitch, from which a pillar counts as collapsed
_DISPLACED = 0.2
# area of a pillar over the median of the picture, up to which it counts as missing
_SMALL = 0.04
# least share of a round pillar's pixels within the ellipse of its area
_ELLIPTIC = 0.8
# level above the gap over that of the rim's crest, from which it belongs to the crest
_CREST = 0.95
# relative scatter of blur and height in one picture; error by the places of the pixels
_COMMON, _PIXEL_ERROR = 0.05, 0.005
# parameters of a disc: row, column, radius, r(t) terms of sin 2t and cos 2t, logarithm
# of the blur, level of the gap, height above it
_BLUR, _HEIGHT = 5, 7


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
                f"pixel_nm {self.pixel_nm}, pitch_nm {self.pitch_nm}: "
                "need 6 or more pixels in a pitch"
            )


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredDiameters:
    """Pillars measured in a micrograph.

    row, column: (p,) centres in pixels.
    diameter_nm: (p,) nan where the pillar is missing, collapsed or oval.
    sigma_nm: (p,) standard error of each diameter: noise of the pixels and a
    hundredth of a pixel. A bright rim adds a constant (edge_bias_nm).
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


class _Cell(NamedTuple):
    """Pixels about a lattice site: (2, n) row and column, (n,) level, (n,) whether they
    belong to its pillar.
    """

    points: Array
    level: Array
    pillar: Array


def measure_diameters(image: Array, about: SemMicrograph) -> MeasuredDiameters:
    """Diameters of all pillars on the lattice of a top-down micrograph.

    A threshold (Otsu 1979) separates the pillars, and their Fourier transform gives the
    lattice. A disc blurred by a Gaussian is fitted to the pixels of every cell, then
    again with the median blur and height of all pillars as priors. Rims must be
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
            f"micrograph of shape {picture.shape}: need one grey "
            "picture (y, x) of finite values"
        )
    stated_px = about.pitch_nm / about.pixel_nm if about.pitch_nm else None
    flat = subtract_background(picture, stated_px or min(picture.shape) / 4)
    lattice = find_lattice(pillar_mask(flat), stated_px)
    pitch = lattice.pitch_px
    flat = subtract_background(picture, pitch)
    labels = ndimage.label(pillar_mask(flat))[0]
    places, site = lattice.sites(flat.shape)
    if not len(places):
        raise CaptureError("no whole pillar in the picture; need a wider picture")
    cells = [_cell(flat, labels, place, pitch / 2) for place in places]
    area = np.array([cell.pillar.sum() for cell in cells])
    missing = area <= _SMALL * np.median(area)
    discs = np.array([_first_disc(cell) for cell in cells])
    upright = ~missing & (np.hypot(*(discs[:, :2] - places).T) < _DISPLACED * pitch)
    discs[~upright, :2] = places[~upright]
    errors = np.full(discs.shape, math.nan)
    fitted = [
        cell for cell, is_upright in zip(cells, upright, strict=True) if is_upright
    ]
    if fitted:
        discs[upright], errors[upright] = _fit_pillars(fitted, discs[upright])
    radius = discs[:, 2]
    second = np.hypot(discs[:, 3], discs[:, 4])
    is_round = [
        is_upright and _elliptic_share(cell, disc) > _ELLIPTIC
        for cell, disc, is_upright in zip(cells, discs, upright, strict=True)
    ]
    on_site = np.hypot(*(discs[:, :2] - places).T) < _DISPLACED * pitch
    collapsed = ~missing & ~(on_site & np.array(is_round) & (second < radius))
    oval = ~missing & ~collapsed & (second > 4 * errors[:, 3])
    oval &= radius + second > _OVAL * (radius - second)
    good = ~(missing | collapsed | oval)
    diameter = 2 * np.sqrt(radius**2 + second**2 / 2) * about.pixel_nm
    return MeasuredDiameters(
        discs[:, 0],
        discs[:, 1],
        np.where(good, diameter - 2 * about.edge_bias_nm, math.nan),
        2 * errors[:, 2] * about.pixel_nm,
        missing,
        collapsed,
        site,
        lattice,
        oval,
    )


def _fit_pillars(cells: Sequence[_Cell], discs: Array) -> tuple[Array, Array]:
    """(k, 8) discs fitted to the pillars of a picture, and their standard errors.

    The first fit has a wide prior on the blur. The second has the median blur and
    height of all pillars as priors.

    Args:
        cells: pixels of the pillars.
        discs: (k, 8) their first discs.
    """
    rim_px = _rim_width(cells, discs)
    sigma = np.full(8, math.inf)
    sigma[_BLUR] = 1.0
    first = np.array(
        [
            fit_blurred_disc(cell, disc, sigma, rim_px)[0]
            for cell, disc in zip(cells, discs, strict=True)
        ]
    )
    blur, height = np.median(first[:, [_BLUR, _HEIGHT]], axis=0)
    spread = 1.4826 * np.median(np.abs(first[:, _HEIGHT] - height))
    sigma[_BLUR] = _COMMON
    sigma[_HEIGHT] = max(spread, _COMMON * height)
    start = discs.copy()
    start[:, _BLUR], start[:, _HEIGHT] = blur, height
    fits = [
        fit_blurred_disc(cell, disc, sigma, rim_px)
        for cell, disc in zip(cells, start, strict=True)
    ]
    return np.array([disc for disc, _ in fits]), np.array([error for _, error in fits])


def subtract_background(image: Array, pitch: float) -> Array:
    """(y, x) picture less its slow background along rows and in 2D.

    Args:
        image: (y, x) picture.
        pitch: distance of neighbours, pixels.
    """
    row_level = ndimage.gaussian_filter1d(np.median(image, axis=1), 2 * pitch)
    flat = image - row_level[:, None]
    return np.asarray(flat - ndimage.gaussian_filter(flat, 1.5 * pitch))


def pillar_mask(flat: Array) -> Array:
    """(y, x) True in pillars: above Otsu's threshold, dark tops within rims filled.

    Args:
        flat: (y, x) picture without background.
    """
    import cv2

    smooth = ndimage.gaussian_filter(flat, 1.0)
    low, high = smooth.min(), smooth.max()
    grey = (255 * (smooth - low) / max(high - low, 1e-300)).astype(np.uint8)
    threshold, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_OTSU)
    return np.asarray(ndimage.binary_fill_holes(grey > threshold))


def _cell(flat: Array, labels: Array, place: Array, reach: float) -> _Cell:
    """Pixels within ``reach`` of a place that belong to its largest pillar or to none.

    Args:
        flat: (y, x) levelled picture.
        labels: (y, x) number of the pillar, 0 in the gaps.
        place: (row, column) of the site.
        reach: pixels.
    """
    low = np.maximum(np.floor(place - reach).astype(int), 0)
    high = np.ceil(place + reach).astype(int) + 1
    window = (slice(low[0], high[0]), slice(low[1], high[1]))
    points = np.stack(np.nonzero(labels[window] >= 0)) + low[:, None]
    label = labels[window].ravel()
    count = np.bincount(label[label > 0], minlength=2)
    inside = np.hypot(*(points - place[:, None])) <= reach
    inside &= (label == 0) | (label == count.argmax())
    return _Cell(points[:, inside], flat[window].ravel()[inside], label[inside] > 0)


def _first_disc(cell: _Cell) -> Array:
    """(8,) disc with the centroid and area of the cell's pillar."""
    pillar = cell.pillar
    if not pillar.any() or pillar.all():
        return np.full(8, math.nan)
    row, column = cell.points[:, pillar].mean(1)
    gap = cell.level[~pillar].mean()
    height = cell.level[pillar].mean() - gap
    radius = math.sqrt(pillar.sum() / math.pi)
    return np.array([row, column, radius, 0, 0, math.log(1.5), gap, height])


def _rim_width(cells: Sequence[_Cell], discs: Array) -> float:
    """Distance from the edge to the inner end of the rim's crest, pixels; the radius of
    the widest pillar where tops are as bright as rims.

    The profile is the mean over all pillars at equal distance inside their edges.

    Args:
        cells: pixels of the pillars.
        discs: (k, 8) their first discs.
    """
    depth = [
        disc[2] - np.hypot(*(cell.points - disc[:2, None]))
        for cell, disc in zip(cells, discs, strict=True)
    ]
    bin_number = np.rint(np.concatenate([[0.0], *depth])).astype(int)
    level = np.concatenate([[0.0], *(cell.level for cell in cells)])
    bin_number, level = bin_number[bin_number >= 0], level[bin_number >= 0]
    profile = np.bincount(bin_number, level) / np.maximum(np.bincount(bin_number), 1)
    gap = np.median(discs[:, 6])
    crest = int(profile.argmax())
    below = np.flatnonzero(profile[crest:] - gap < _CREST * (profile[crest] - gap))
    return float(crest + below[0] - 1) if len(below) else math.inf


def fit_blurred_disc(
    cell: _Cell,
    mean: Array,
    sigma: Array,
    rim_px: float,
    *,
    iterations: int = 30,
    longest_px: float = 1.0,
    tolerance_px: float = 1e-3,
) -> tuple[Array, Array]:
    """Gauss-Newton fit of a blurred disc to the pixels from the crest of its rim
    outwards, with white noise and Gaussian priors: (8,) parameters, standard errors.

    Args:
        cell: pixels of the pillar.
        mean: (8,) start and mean of the prior.
        sigma: (8,) standard deviations of the prior.
        rim_px: distance from the edge to the inner end of the crest.
        iterations: largest number of steps.
        longest_px: longest step, beyond which edges next to each other are confused.
        tolerance_px: step that ends the fit.
    """
    reach = np.hypot(*(cell.points - mean[:2, None]))
    order = np.argsort(reach)[np.count_nonzero(reach < mean[2] - rim_px) :]
    points, level = cell.points[:, order], cell.level[order]
    disc = mean.copy()
    for _ in range(iterations):
        expected, slopes = blurred_disc_image(points, disc)
        residual = level - expected
        variance = residual @ residual / max(len(level) - 8, 1) + 1e-12 * mean[7] ** 2
        covariance = np.linalg.pinv(slopes.T @ slopes / variance + np.diag(sigma**-2))
        step = covariance @ (slopes.T @ residual / variance + (mean - disc) / sigma**2)
        length = np.abs(step[:5]).max()
        disc += step * min(1, longest_px / length)
        if length < tolerance_px:
            break
    return disc, np.sqrt(np.diag(covariance) + _PIXEL_ERROR**2)


def blurred_disc_image(points: Array, disc: Array) -> tuple[Array, Array]:
    """Levels of a disc blurred by a Gaussian at (2, n) points, and their (n, 8)
    derivatives.

    A disc of radius R and blur s has the derivatives R / s² exp(-(R² + r²) / 2 s²)
    times I0(R r / s²) by R and -I1(R r / s²) by the distance r from its middle, where
    its level is 1 - exp(-R² / 2 s²). The level is the integral along r.

    Args:
        points: (2, n) row and column.
        disc: (8,) row, column, radius R, terms of sin 2t and cos 2t that are taken off
            r, log s, level of the gap, height.
    """
    row, column, radius, sine_term, cosine_term, log_blur, gap, height = disc
    dy, dx = points[0] - row, points[1] - column
    distance = np.maximum(np.hypot(dy, dx), 1e-9)
    sine, cosine = dy / distance, dx / distance
    sine2, cosine2 = 2 * sine * cosine, cosine**2 - sine**2
    r = np.maximum(distance - sine_term * sine2 - cosine_term * cosine2, 0)
    blur = math.exp(np.clip(log_blur, -2, 5))
    grid = np.arange(0, r.max() + blur, blur / 10)
    density = radius / blur**2 * np.exp(-0.5 * ((grid - radius) / blur) ** 2)
    falls = density * special.i1e(radius * grid / blur**2)
    middle = -math.expm1(-0.5 * (radius / blur) ** 2)
    levels = middle - integrate.cumulative_trapezoid(falls, grid, initial=0)
    by_r = -np.interp(r, grid, falls)
    by_radius = np.interp(r, grid, density * special.i0e(radius * grid / blur**2))
    level = np.interp(r, grid, levels)
    by_disc = [-sine * by_r, -cosine * by_r, by_radius, -sine2 * by_r, -cosine2 * by_r]
    by_disc.append(-radius * by_radius - r * by_r)
    slopes = [*(height * slope for slope in by_disc), np.ones_like(r), level]
    return gap + height * level, np.stack(slopes, 1)


def _elliptic_share(cell: _Cell, disc: Array) -> float:
    """Share of a pillar's pixels within the fitted ellipse of its area."""
    levels = blurred_disc_image(cell.points, disc)[0]
    brightest = np.argsort(-levels, kind="stable")[: cell.pillar.sum()]
    return float(cell.pillar[brightest].mean())


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
    along_rows = np.array([[0, 0, 0], [1, 1, 1], [0, 0, 0]])
    runs = ndimage.label(strip >= strip.max(), along_rows)[0]
    longest = int(np.bincount(runs.ravel())[1:].max())
    if longest < 20:
        raise CaptureError(
            f"no scale bar: longest bright run is {longest} pixels; "
            "give pixel_nm instead"
        )
    return bar_nm / longest
