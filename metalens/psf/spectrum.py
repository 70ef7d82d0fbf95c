"""LED times sensor response as a few wavelengths with weights: Gauss quadrature for
that very weight.
"""

import functools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from metalens.core import reading
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError, nearest_name_hint

if TYPE_CHECKING:
    from colour import SpectralDistribution

MOST_NODES = 64
STEP_NM = 0.25  # at most, between points of a spectrum
PATHS = 129  # from 0 to the longest, at which a rule is judged
SUM_ERROR = 1e-6  # of the sum of weights: a relative error of all light
LEAST_FWHM_NM = 1e-3  # a narrower line is one wavelength to any lens: 1e-6 of it


@dataclass(frozen=True, slots=True)
class Source:
    """Light-emitting diode as a silicon sensor detects it: spectrum, filter and sensor
    response.

    peak_nm, fwhm_nm: of the diode, a Gaussian line.
    silicon_um: thickness of silicon that collects charge; the response is 1 -
    exp(-4πk·thickness/λ) with k of
        crystalline silicon, times λ (photons per watt).
    """

    peak_nm: float = 850.0
    fwhm_nm: float = 30.0
    silicon_um: float = 6.0

    def __post_init__(self) -> None:
        positive = self.peak_nm > 0 and self.silicon_um > 0
        if not (positive and self.fwhm_nm >= LEAST_FWHM_NM):
            raise PropagationError(
                f"{self}: need a peak and a thickness above 0, and a width of "
                f"{LEAST_FWHM_NM:g} nm or more; a narrower line is one wavelength"
            )


@dataclass(frozen=True, eq=False, slots=True)
class SpectralNodes:
    """Wavelengths and weights of a quadrature over a spectrum, and its error.

    wavelengths_um, weights: (n,), the weights of sum 1.
    error: of the quadrature, for the paths that it was chosen for.
    source: the spectrum, by which their error is computed for any path;
        None for plain wavelengths.

    Raises:
        PropagationError: no wavelength, one that is not above 0, or weights that are
            not one of 0 or more for each, of
            sum 1.
    """

    wavelengths_um: Array
    weights: Array
    error: float
    source: "Source | MeasuredSpectrum | None" = None

    def __post_init__(self) -> None:
        waves = np.asarray(self.wavelengths_um)
        weights = np.asarray(self.weights)
        if (
            waves.ndim != 1
            or not len(waves)
            or not (np.isfinite(waves) & (waves > 0)).all()
        ):
            raise PropagationError(
                f"wavelengths_um is {waves.tolist()}, need one wavelength above 0 or more"
            )
        if (
            weights.shape != waves.shape
            or not (weights >= 0).all()
            or not abs(weights.sum() - 1) <= SUM_ERROR
        ):
            raise PropagationError(
                f"{len(waves)} wavelengths with weights {weights.tolist()}, need one of 0 or more each, sum 1"
            )


def single_wavelength(wavelength_um: float) -> SpectralNodes:
    """The rule of one wavelength, ``wavelength_um``."""
    return SpectralNodes(np.array([wavelength_um]), np.ones(1), 0.0)


@functools.lru_cache(maxsize=8)
def spectral_weight(source: Source) -> tuple[Array, Array]:
    """Wavelengths (n,) in um and weights of sum 1 of a diode on a silicon sensor.

    weight ∝ exp(-4 ln 2 ((λ - peak) / FWHM)²) λ (1 - exp(-4π k thickness / λ)) over
    ±2.5 FWHM, every 0.25 nm or FWHM / 40, whichever is less.

    Args:
        source: peak, width and thickness of silicon.

    Raises:
        MaterialError: the line leaves the range of the silicon data.
    """
    from metalens.cell import materials

    step_nm = min(STEP_NM, source.fwhm_nm / 40)
    count = round(2.5 * source.fwhm_nm / step_nm)
    widths = np.arange(-count, count + 1) * step_nm / source.fwhm_nm
    um = (source.peak_nm + widths * source.fwhm_nm) * 1e-3
    k = np.array([materials.index("Si", w).imag for w in um])
    response = um * (1 - np.exp(-4 * np.pi * k * source.silicon_um / um))
    value = np.exp(-4 * np.log(2) * widths**2) * response
    return um, value / value.sum()


@dataclass(frozen=True, eq=False, slots=True)
class MeasuredSpectrum:
    """A spectrum as measured: wavelengths (n,) in um, ascending, and weights of sum 1.

    outside: share of the light that is cut off at its ends, beyond the wavelengths of
        the pillars' library.
    """

    wavelengths_um: Array
    share: Array
    outside: float = 0.0


def read_measured_spectrum(
    curves: "Sequence[Path | str | SpectralDistribution]",
    *,
    within_um: tuple[float, float],
) -> MeasuredSpectrum:
    """Normalised product of measured curves (source, filter, sensor), where all exist.

    A file has two columns, wavelength and value, separated by commas, semicolons or
    blanks. Wavelengths are in nm, or in um where the names of columns say so. Lines
    that start with # are skipped. Where semicolons, tabs or blanks separate the
    columns, a comma is the decimal point.

    colour-science interpolates the values linearly. The product is integrated by
    two-point Gauss rules between the rows of all curves, and over 0.25 nm at most. A
    constant factor of each curve drops out.

    Args:
        curves: each a file, a name among colour-science's spectral distributions
            (``SDS_ILLUMINANTS``, ``SDS_LIGHT_SOURCES``, ``SDS_FILTERS``,
            ``SDS_LENSES``, ``SDS_LEFS``), or such a distribution.
        within_um: (least, largest) wavelength of the pillars' library, um; equal for a
            single wavelength, which cuts nothing off.

    Raises:
        PropagationError: no curve, a missing or malformed file, curves without a common
            range, or light outside ``within_um`` (less than 1e-4 of the largest value
            is cut off).
    """
    if not curves:
        raise PropagationError(
            "spectrum: no curve; need one of wavelength in nm and value, or more"
        )
    responses = [_response(curve) for curve in curves]
    names = ", ".join(getattr(curve, "name", str(curve)) for curve in curves)
    low = max(response.domain[0] for response in responses)
    high = min(response.domain[-1] for response in responses)
    if low >= high:
        raise PropagationError(f"spectrum: {names} share no wavelength")
    rows = np.concatenate(
        [r.domain for r in responses] + [np.arange(low, high, STEP_NM)]
    )
    ends = np.unique(np.clip(rows, low, high))
    half = np.diff(ends) / 2
    middle = (ends[1:] + ends[:-1]) / 2
    # Gauss, of third degree
    nm = np.stack([middle - half / np.sqrt(3), middle + half / np.sqrt(3)], 1).ravel()
    value = np.prod([response[nm] for response in responses], axis=0)
    share = value * np.repeat(half, 2)
    if not share.sum() > 0:
        raise PropagationError(f"spectrum: the product of {names} is 0 everywhere")
    share = share / share.sum()
    um = nm * 1e-3
    bright = value > 1e-4 * value.max()
    inside = bright
    if within_um[1] > within_um[0]:
        inside = _is_within(um, within_um) & (value > 0)
    if (bright & ~inside).any():
        band = um[bright], value[bright] / value[bright].sum()
        raise _refusal(band, within_um, "narrow it (a filter among the files)")
    kept = float(share[inside].sum())
    return MeasuredSpectrum(um[inside], share[inside] / kept, max(0.0, 1 - kept))


def _is_within(um: Array, within_um: tuple[float, float]) -> Array:
    """Whether wavelengths lie in the range of a library, to 1e-6 um."""
    return np.asarray((um >= within_um[0] - 1e-6) & (um <= within_um[1] + 1e-6))


def _response(curve: "Path | str | SpectralDistribution") -> "SpectralDistribution":
    """The distribution of a file, name or distribution, interpolated linearly.

    Raises:
        PropagationError: no such file or name, or values that are not 0 or more.
    """
    import colour

    known = {
        **colour.SDS_ILLUMINANTS,
        **colour.SDS_LIGHT_SOURCES,
        **colour.SDS_FILTERS,
        **colour.SDS_LENSES,
        **colour.SDS_LEFS,
    }
    if not isinstance(curve, str | Path):
        response = curve.copy()
    elif Path(curve).is_file():
        nm, values = _read_curve(Path(curve)).T
        response = colour.SpectralDistribution(values, nm, name=str(curve))
    elif str(curve) in known:
        response = known[str(curve)].copy()
    else:
        hint = "" if Path(curve).suffix else nearest_name_hint(str(curve), known)
        raise PropagationError(
            f"{curve}: cannot be read: no such file, nor a distribution of "
            f"colour-science{hint}"
        )
    if not (response.range >= 0).all():
        raise PropagationError(f"spectrum: {response.name} has values below 0")
    response.interpolator = colour.LinearInterpolator
    return response


def _read_curve(file: Path) -> Array:
    """(n, [nm, value]) rows of a file, ascending in wavelength.

    Raises:
        PropagationError: a file that is no such table, naming the line.
    """
    rows: list[list[float]] = []
    scale = 1.0  # nm per unit of the first column
    try:
        lines = reading.read_text(file).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PropagationError(
            f"{file}: cannot be read as a table of wavelength and value: {error}"
        ) from None
    for number, line in enumerate(lines, 1):
        words = reading.split_columns(line)
        if not rows and re.match(r"[^,;\d]*?(\b|_)([uµμ]m\b|micro)", line, re.I):
            scale = 1e3
        if not words or words[0][0] in "#\"'":
            continue
        try:
            nm, value = scale * float(words[0]), float(words[1])
        except (ValueError, IndexError):
            if not rows:  # names of columns
                continue
            nm = value = math.nan
        if not (100 <= nm < np.inf and 0 <= value < np.inf):
            raise PropagationError(
                f"{file}: line {number} is {line[:60]!r}, need a wavelength in nm (100 "
                "or more) and a value of 0 or more: name a column of micrometres "
                "wavelength_um, and set what noise left below 0 to 0"
            )
        rows.append([nm, value])
    if len(rows) < 2:
        raise PropagationError(
            f"{file}: {len(rows)} rows, need two or more of wavelength in nm and value; a single line is wavelengths_nm"
        )
    table = np.array(sorted(rows))
    if not (np.diff(table[:, 0]) > 0).all():
        raise PropagationError(f"{file}: need one value for each wavelength")
    return table


def spectral_nodes(
    source: Source | MeasuredSpectrum,
    *,
    path_um: float | Array,
    tolerance: float,
    light: Array | None = None,
) -> SpectralNodes:
    """The Gauss rule of fewest wavelengths that meets the tolerance.

    Irradiance varies with wavelength as exp(2πi·path/λ) at most, path the difference of
    optical paths through two parts of the lens. The rule's error is that of the mean of
    this exponential over the spectrum.

    Args:
        source: spectrum of the source.
        path_um: largest difference of paths to the window, um; or (n,) to its parts.
        tolerance: error, root mean square over the parts.
        light: (n,) share of each part in the squared irradiance; None for one part.

    Raises:
        PropagationError: more than 64 wavelengths would be needed.
    """
    spans = np.atleast_1d(path_um)
    light = np.ones(1) if light is None else light
    um, share = spectrum_points(source)
    for count in range(1, MOST_NODES + 1):
        rule = discrete_gauss_rule(um, share, count)
        error = quadrature_error(source, rule, spans, light)
        if error <= tolerance:
            return SpectralNodes(*rule, error, source)
    raise PropagationError(
        f"more than {MOST_NODES} wavelengths needed for paths of {spans.max():.3g} um under a line from "
        f"{um[0] * 1e3:.1f} to {um[-1] * 1e3:.1f} nm; raise the tolerance or narrow the line"
    )


def quadrature_error(
    source: Source | MeasuredSpectrum,
    rule: tuple[Array, Array],
    span_um: Array,
    light: Array,
) -> float:
    """Root mean square error over a window of a rule of wavelengths for a spectrum.

    That of a part of the window is the largest difference of two means of
    exp(2πi·path/λ), over paths up to the part's span; light outside a measured spectrum
    is added.

    Args:
        source: spectrum of the source.
        rule: wavelengths in um and weights.
        span_um: (n,) largest difference of optical paths to each part, um.
        light: (n,) share of each part in the squared irradiance.
    """
    paths = np.linspace(0, span_um.max(), PATHS)
    means = [
        np.exp(2j * np.pi * paths[:, None] / um) @ weights
        for um, weights in (rule, spectrum_points(source))
    ]
    largest = np.maximum.accumulate(np.abs(means[0] - means[1]))
    place = np.searchsorted(paths, span_um * (1 - 1e-12)).clip(max=PATHS - 1)
    outside = source.outside if isinstance(source, MeasuredSpectrum) else 0.0
    return float(np.sqrt(light @ (outside + largest[place]) ** 2))


def spectrum_points(source: Source | MeasuredSpectrum) -> tuple[Array, Array]:
    """(wavelengths in um, shares of sum 1) of a spectrum.

    Args:
        source: spectrum of the source.
    """
    if isinstance(source, MeasuredSpectrum):
        return source.wavelengths_um, source.share
    return spectral_weight(source)


def share_outside_library(
    source: Source | MeasuredSpectrum | SpectralNodes | None,
    within_um: tuple[float, float],
) -> float:
    """Share of a spectrum's light outside the wavelengths of the pillars' library.

    Nodes within the library stand for that light. The share is no error of that size:
    where the response continues smoothly, the error is that of the quadrature. It is 0
    of plain wavelengths, and of a library of one wavelength, which raises elsewhere.

    Args:
        source: spectrum of the source.
        within_um: (least, largest) wavelength of the library, um.
    """
    low, high = within_um
    if not high > low or not isinstance(source, Source | MeasuredSpectrum):
        return 0.0
    um, share = spectrum_points(source)
    return float(share[~_is_within(um, within_um)].sum())


def nodes_inside_library(
    nodes: SpectralNodes,
    source: Source | MeasuredSpectrum,
    within_um: tuple[float, float],
) -> SpectralNodes:
    """The nodes, unchanged, if all lie within the wavelengths of the pillars' library.

    Args:
        nodes: wavelengths with their weights.
        source: the spectrum of which they are a quadrature.
        within_um: (least, largest) wavelength of the library, um.

    Raises:
        PropagationError: a node lies outside; the text names the share of the light
            outside, and the cure.
    """
    low, high = within_um
    um = np.asarray(nodes.wavelengths_um)
    if ((low - 1e-9 <= um) & (um <= high + 1e-9)).all():
        return nodes
    narrow = "narrow it (a filter among the files)"
    if isinstance(source, Source):  # no node lies beyond 2.5 widths
        width = min(source.peak_nm - low * 1e3, high * 1e3 - source.peak_nm) / 2.5
        narrow = ""
        if width >= LEAST_FWHM_NM:
            narrow = f"narrow it to a width of {math.floor(width * 10) / 10:g} nm"
    raise _refusal(spectrum_points(source), within_um, narrow)


def _refusal(
    light: tuple[Array, Array], within_um: tuple[float, float], narrow: str
) -> PropagationError:
    """The error for light outside the pillars' library, with its share and the cure.

    Args:
        light: wavelengths in um, ascending, and shares of sum 1.
        within_um: (least, largest) wavelength of the library.
        narrow: words for how to narrow the spectrum; may be empty.
    """
    um, share = light
    low, high = (edge * 1e3 for edge in within_um)
    library, part = f"at {low:g} nm alone", 1.0
    if high > low:
        library = f"from {low:g} to {high:g} nm"
        part = float(share[~_is_within(um, within_um)].sum())
    ends = math.floor(um[0] * 1e3) / 1e3, math.ceil(um[-1] * 1e3) / 1e3
    return PropagationError(
        f"spectrum: light from {um[0] * 1e3:g} to {um[-1] * 1e3:g} nm, the pillars are known {library}, and {part:.2g} "
        f"of it lies beyond: {narrow}{', or ' * bool(narrow)}sweep a library over it "
        f"([sweep] wavelengths_um = [{ends[0]:g}, {sum(ends) / 2:.6g}, {ends[1]:g}])"
    )


def outside_library_text(
    source: Source | MeasuredSpectrum | SpectralNodes | None,
    within_um: tuple[float, float],
) -> str:
    """Words for the :func:`share_outside_library`; empty where it is below 1e-4.

    Args:
        source: spectrum of the source.
        within_um: (least, largest) wavelength of the library, um.
    """
    share = share_outside_library(source, within_um)
    if share < 1e-4:
        return ""
    low, high = within_um
    return (
        f"; {share:.2g} of the light lies beyond {low * 1e3:g} to {high * 1e3:g} nm, where the pillars are not "
        "known, and is taken by the wavelengths within: sweep a library over the spectrum"
    )


def discrete_gauss_rule(points: Array, share: Array, count: int) -> tuple[Array, Array]:
    """Nodes (count,) and weights of the Gauss rule of a discrete weight.

    It is exact for polynomials of degree 2·count - 1. Polynomials that are orthogonal
    under the weight, by a QR factorisation of Chebyshev polynomials, give the Jacobi
    matrix. Its eigenvalues are the nodes (Golub and Welsch).

    Args:
        points: (n,) abscissas.
        share: (n,) weights.
        count: nodes, at most n.
    """
    count = min(count, len(points))
    middle, half = (points[0] + points[-1]) / 2, max(np.ptp(points) / 2, 1e-300)
    u = (points - middle) / half
    basis, _ = np.linalg.qr(
        np.sqrt(share)[:, None] * np.polynomial.chebyshev.chebvander(u, count - 1)
    )
    nodes, vectors = np.linalg.eigh(basis.T @ (u[:, None] * basis))
    return middle + half * nodes, vectors[0] ** 2 * share.sum()
