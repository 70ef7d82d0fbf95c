"""LED times sensor response as a few wavelengths with weights: Gauss quadrature for that very weight."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from metalens.ground.arrays import Array
from metalens.ground.errors import PropagationError
from metalens.ground.paths import path_difference

MOST_NODES = 64
LEAST_FWHM_NM = 1e-3  # a narrower line is one wavelength to any lens: 1e-6 of it


@dataclass(frozen=True, slots=True)
class Source:
    """A light-emitting diode seen by a silicon sensor.

    peak_nm, fwhm_nm: of the diode, a Gaussian line.
    silicon_um: thickness of silicon that collects charge; the response is 1 - exp(-4πk·thickness/λ) with k of
        crystalline silicon, times λ (photons per watt).
    """

    peak_nm: float = 850.0
    fwhm_nm: float = 30.0
    silicon_um: float = 6.0

    def __post_init__(self) -> None:
        if not (self.peak_nm > 0 and self.fwhm_nm > 0 and self.silicon_um > 0):
            raise PropagationError(f"{self}: peak, width and thickness must be above 0")
        if self.fwhm_nm < LEAST_FWHM_NM:
            raise PropagationError(
                f"{self}: a line of less than {LEAST_FWHM_NM:g} nm is one wavelength; give no width for it"
            )


@dataclass(frozen=True, eq=False, slots=True)
class Nodes:
    """wavelengths_um and weights (sum 1), and the error of the quadrature on the band that was asked for."""

    wavelengths_um: Array
    weights: Array
    error: float


def weight(source: Source) -> tuple[Array, Array]:
    """(wavelengths in um, weight of sum 1) of diode times silicon over ±2.5 FWHM, every 0.25 nm or FWHM / 40.

    Raises:
        MaterialError: the line leaves the range of the silicon data.
    """
    from metalens.cell import materials

    step_nm = min(0.25, source.fwhm_nm / 40)
    for end_nm in (-2.5 * source.fwhm_nm, 2.5 * source.fwhm_nm):  # before an absurd width takes memory
        materials.index("Si", (source.peak_nm + end_nm) * 1e-3)
    count = round(2.5 * source.fwhm_nm / step_nm)
    away = np.arange(-count, count + 1) * step_nm / source.fwhm_nm
    um = (source.peak_nm + away * source.fwhm_nm) * 1e-3
    k = np.array([materials.index("Si", w).imag for w in um])
    seen = um * (1 - np.exp(-4 * np.pi * k * source.silicon_um / um))
    value = np.exp(-4 * np.log(2) * away**2) * seen
    return um, value / value.sum()


@dataclass(frozen=True, eq=False, slots=True)
class Measured:
    """A spectrum as measured: wavelengths (n,) in um, ascending, and weights of sum 1."""

    wavelengths_um: Array
    share: Array


def measured(files: Sequence[Path], *, within_um: tuple[float, float]) -> Measured:
    """Product of measured curves (LED, filter, sensor), every 0.25 nm where all of them are known.

    A file has two columns, wavelength in nm and value, parted by commas, semicolons or blanks; lines that start with #
    or with a word are skipped. Values are interpolated linearly; a constant factor of each drops out.

    Raises:
        PropagationError: a file that is missing or no such table, curves without a common range, or light outside
            ``within_um``, which the pillars are known for.
    """
    curves = [_curve(file) for file in files]
    low, high = max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves)
    if low >= high:
        raise PropagationError(f"spectrum: {', '.join(map(str, files))} share no wavelength")
    nm = np.arange(low, high + 1e-9, 0.25)
    value = np.prod([np.interp(nm, c[:, 0], c[:, 1]) for c in curves], axis=0)
    if not value.sum() > 0:
        raise PropagationError(f"spectrum: the product of {', '.join(map(str, files))} is 0 everywhere")
    share = value / value.sum()
    lit = np.flatnonzero(share > 1e-4 * share.max())
    nm, share = nm[lit[0] : lit[-1] + 1], share[lit[0] : lit[-1] + 1]
    if within_um[1] > within_um[0] and not (
        within_um[0] - 1e-6 <= nm[0] * 1e-3 and nm[-1] * 1e-3 <= within_um[1] + 1e-6
    ):
        raise PropagationError(
            f"spectrum: light from {nm[0]:g} to {nm[-1]:g} nm, the pillars are known from {within_um[0] * 1e3:g} to "
            f"{within_um[1] * 1e3:g} nm: sweep a library over the spectrum"
        )
    return Measured(nm * 1e-3, share / share.sum())


def _curve(file: Path) -> Array:
    """(n, [nm, value]) of a file, ascending."""
    rows = []
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PropagationError(f"{file}: cannot be read as a table of wavelength and value: {error}") from None
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").replace(";", " ").split()
        if not words or words[0][0] in "#\"'" or words[0][0].isalpha():
            continue
        try:
            rows.append([float(words[0]), float(words[1])])
        except (ValueError, IndexError):
            raise PropagationError(f"{file}: line {number} is {line[:60]!r}, need wavelength in nm and value") from None
    table = np.array(sorted(rows))
    if len(rows) < 2 or not np.isfinite(table).all() or table[0, 0] < 100 or (table[:, 1] < 0).any():
        raise PropagationError(f"{file}: need two rows or more of wavelength in nm (100 or more) and value (0 or more)")
    if (np.diff(table[:, 0]) <= 0).any():
        raise PropagationError(f"{file}: a wavelength stands twice; need one value for each")
    return table


def nodes(source: Source | Measured, *, path_um: float, tolerance: float) -> Nodes:
    """As few wavelengths as meet the tolerance.

    Args:
        path_um: largest difference in optical path between two parts of the lens, for light that reaches the window
            (:func:`path_span`): intensities vary with wavelength as exp(2πi·path/λ), and no faster.
        tolerance: of the mean over the spectrum of every such exponential.

    Raises:
        PropagationError: more than 64 wavelengths would be needed.
    """
    um, share = (source.wavelengths_um, source.share) if isinstance(source, Measured) else weight(source)
    paths = np.linspace(0, path_um, 65)[:, None]
    want = np.exp(2j * np.pi * paths / um) @ share
    for count in range(1, MOST_NODES + 1):
        x, w = gauss(um, share, count)
        error = float(np.abs(np.exp(2j * np.pi * paths / x) @ w - want).max())
        if error <= tolerance:
            return Nodes(x, w, error)
    raise PropagationError(
        f"more than {MOST_NODES} wavelengths needed for paths of {path_um:.3g} um under a line from "
        f"{um[0] * 1e3:.1f} to {um[-1] * 1e3:.1f} nm; raise the tolerance or narrow the line"
    )


def gauss(points: Array, share: Array, count: int) -> tuple[Array, Array]:
    """Gauss rule of a discrete weight: exact for polynomials of degree 2·count - 1 (Lanczos, Golub and Welsch)."""
    count = min(count, len(points))
    basis, diagonal, beside = np.zeros((count, len(points))), np.zeros(count), np.zeros(count)
    q = np.sqrt(share / share.sum())
    for i in range(count):
        basis[i] = q
        r = points * q
        diagonal[i] = q @ r
        r = r - basis[: i + 1].T @ (basis[: i + 1] @ r)
        r = r - basis[: i + 1].T @ (basis[: i + 1] @ r)
        beside[i] = np.linalg.norm(r)
        q = r / beside[i] if beside[i] > 0 else r
    values, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(beside[:-1], 1) + np.diag(beside[:-1], -1))
    return values, vectors[0] ** 2 * share.sum()


def path_span(radius_um: float, sensor_distance_um: float, nearest_depth_um: float) -> float:
    """Path from axis to rim on both sides, um: bounds how fast a PSF changes with wavelength."""
    return float(path_difference(radius_um**2, nearest_depth_um) + path_difference(radius_um**2, sensor_distance_um))
