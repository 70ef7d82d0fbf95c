"""Coupling of non-identical neighbours in a lens: a factor by the angle that it is
turned by.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import LensError

# share of the factor's change that real zones may lack, as they shorten towards the
# rim: from a full solve of a lens cut (python -m benchmarks neighbours)
CURVED = 0.2
_ARRAYS = ("sine", "diagonal", "factor", "coarse", "scatter")


@dataclass(frozen=True, eq=False, slots=True)
class NeighbourRows:
    """Supercell responses of rows of non-identical pillars of a lens.

    sine: (n,) by which a row turns light.
    diagonal: (n,) whether it runs along the diagonal of the lattice.
    factor: (2, n) complex tangential amplitude in the intended direction, over that of
        the locally periodic model; for fields along the row, and across it.
    coarse: (2, n) the same at a coarser truncation.
    scatter: (n,) share of the transmitted power in other directions, beyond that of the
        locally periodic model.
    wavelength_um: of the rows.
    cover: index of the medium behind the pillars.

    Raises:
        LensError: arrays that do not belong together, no row along the lattice, a sine
            not above 0.
    """

    sine: Array
    diagonal: Array
    factor: Array
    coarse: Array
    scatter: Array
    wavelength_um: float
    cover: float = 1.0

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit together."""
        n = len(self.sine)
        shapes = {name: np.shape(getattr(self, name)) for name in _ARRAYS}
        if shapes != {
            "sine": (n,),
            "diagonal": (n,),
            "factor": (2, n),
            "coarse": (2, n),
            "scatter": (n,),
        }:
            raise LensError(
                f"rows of non-identical pillars: arrays of shapes {shapes}, need one entry a row"
            )
        if not (n and not np.all(self.diagonal) and np.all(np.asarray(self.sine) > 0)):
            raise LensError(
                "rows of non-identical pillars: need one along the lattice, and sines above 0"
            )

    @property
    def coefficients(self) -> Array:
        """(2, 2, 2) complex a and b of the factor 1 + a s + b s² of the sine s, by
        least squares.

        Axes: along the lattice and its diagonal, field along the slope and across, a
        and b. The factor is that of the power-normalised amplitude. Without diagonal
        rows, those along the lattice are used for both.
        """
        cosine = np.sqrt(np.maximum(1 - (self.sine / self.cover) ** 2, 1e-9))
        amplitude = self.factor * np.stack([cosine**-0.5, cosine**0.5])
        fits: list[Array] = []
        for rows in (~self.diagonal, self.diagonal):
            if not rows.any():  # no rows along the diagonal
                return np.stack([fits[0], fits[0]])
            terms = np.stack([self.sine[rows], self.sine[rows] ** 2], 1).astype(complex)
            fits.append(
                np.linalg.lstsq(terms, amplitude[:, rows].T - 1, rcond=None)[0].T
            )
        return np.stack(fits)

    @property
    def steepest(self) -> tuple[float, float]:
        """Largest solved sines along the lattice and along its diagonal (0 where none
        was; at most that along the lattice).
        """
        straight, diagonal = (
            float(self.sine[rows].max(initial=0.0))
            for rows in (~self.diagonal, self.diagonal)
        )
        return straight, min(straight, diagonal)

    def of_field(self, field: int, sine: Any, azimuth_weight: Any) -> Any:
        """(…) complex factor C of fields along the slope (0) or across it (1); NumPy or
        torch, differentiable.

        Args:
            field: 0 or 1.
            sine: (…) by which the slope turns light of the rows' wavelength.
            azimuth_weight: sin² 2α of its azimuth α.
        """
        return self._factor(self.coefficients[:, field], sine, azimuth_weight)

    def of_both(self, sine: Any, azimuth_weight: Any) -> Any:
        """(…) complex factor C, the mean of both fields; otherwise as :meth:`of_field`."""
        return self._factor(self.coefficients.mean(1), sine, azimuth_weight)

    def _factor(self, coefficients: Array, sine: Any, azimuth_weight: Any) -> Any:
        """(…) 1 + a s + b s² + sin² 2α (a' s + b' s²), with a', b' the differences
        between diagonal and lattice.

        s is the magnitude of the sine, limited to the solved range.

        Args:
            coefficients: (2, 2) a and b, along the lattice and its diagonal.
            sine: (…) NumPy or torch.
            azimuth_weight: sin² 2α.
        """
        straight, diagonal = coefficients
        (a, b), (a2, b2) = straight.tolist(), (diagonal - straight).tolist()
        s, s2 = (abs(sine).clip(max=limit) for limit in self.steepest)
        return 1 + s * (a + b * s) + azimuth_weight * (s2 * (a2 + b2 * s2))

    def at(self, sine: Array, azimuth_rad: Array | float = 0.0) -> Array:
        """(2, …) complex factor C of fields along the slope and across it, for slopes
        in one azimuth of the lattice.

        Args:
            sine: (…) by which the slope turns light.
            azimuth_rad: of the slope, from a lattice axis.
        """
        azimuth_weight = np.sin(2 * np.asarray(azimuth_rad)) ** 2
        return np.stack(
            [self.of_field(field, np.asarray(sine), azimuth_weight) for field in (0, 1)]
        )

    def mean(self, sine: Array) -> Array:
        """(…) complex factor C, the mean of both polarisations and of all azimuths."""
        return np.asarray(self.at(sine, math.pi / 8).mean(0))  # where sin² 2α is 1/2

    def share(self, sine: Array, weight: Array) -> float:
        """Focus power with coupled neighbours over that of the locally periodic
        approximation: |Σ weight C(sine)|².

        Args:
            sine: (m,) by which zones turn light.
            weight: (m,) share of the lens in each zone, of sum 1.
        """
        return float(abs(weight @ self.mean(sine)) ** 2)

    def without(self, row: int) -> "NeighbourRows":
        """The rows without the one at index ``row``."""
        return replace(
            self,
            **{name: np.delete(getattr(self, name), row, axis=-1) for name in _ARRAYS},
        )

    @property
    def coarser(self) -> "NeighbourRows":
        """The rows with their factors at the coarser truncation."""
        return replace(self, factor=self.coarse)

    @property
    def others(self) -> list["NeighbourRows"]:
        """Leave-one-out variants of the rows, each with at least one row along the
        lattice.
        """
        removable = [
            k
            for k in range(len(self.sine))
            if self.diagonal[k] or np.count_nonzero(~self.diagonal) > 1
        ]
        return [self.without(k) for k in removable]
