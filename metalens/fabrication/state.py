"""A made lens as numbers: so much of every cause, and what that does to its pillars."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import ConfigError, nearest_name_hint
from metalens.fabrication.perturbations import (
    PERTURBATIONS,
    CDError,
    ResponseError,
    WavefrontError,
    of_kind,
    polynomials,
)


@dataclass(frozen=True, eq=False, slots=True)
class State:
    """How much of each cause a lens has: (causes,) in the order and units of
    :data:`metalens.fabrication.PERTURBATIONS`.
    """

    amounts: Array

    @classmethod
    def of(cls, values: Mapping[str, float] | None = None) -> Self:
        """The state with these amounts by name, the rest as designed.

        Raises:
            ConfigError: an unknown name.
        """
        names = [row.name for row in PERTURBATIONS]
        for name in values or {}:
            if name not in names:
                raise ConfigError(
                    f"unknown cause {name!r}{nearest_name_hint(name, names)}"
                )
        return cls(np.array([(values or {}).get(name, 0.0) for name in names]))

    def __getitem__(self, name: str) -> float:
        return float(self.amounts[[row.name for row in PERTURBATIONS].index(name)])

    def bias_polynomial_um(self) -> Array:
        """(i, j) coefficients of u^i v^j of the change of the diameters."""
        return self._polynomial(CDError)

    def bias_um(self, u: Array, v: Array) -> Array:
        """Change of the diameters at lens places over the radius; shapes broadcast."""
        u, v = np.broadcast_arrays(u, v)
        return np.asarray(
            np.polynomial.polynomial.polyval2d(u, v, self.bias_polynomial_um())
        )

    def phase_rad(self, u: Array, v: Array) -> Array:
        """Phase added to the wave front at lens places over the radius; shapes
        broadcast.
        """
        u, v = np.broadcast_arrays(u, v)
        return np.asarray(
            np.polynomial.polynomial.polyval2d(u, v, self._polynomial(WavefrontError))
        )

    def bends(self) -> bool:
        """Whether the wave front has any phase of its own."""
        return bool(self._of(WavefrontError).any())

    def answers(self) -> Array:
        """(pillar-response errors,) amounts in um, rad and 1, as the pillars'
        derivatives
        take them.
        """
        return self._of(ResponseError) * [row.unit for _, row in of_kind(ResponseError)]

    def _of(
        self, kind: type[CDError] | type[ResponseError] | type[WavefrontError]
    ) -> Array:
        return self.amounts[[n for n, _ in of_kind(kind)]]

    def _polynomial(self, kind: type[CDError] | type[WavefrontError]) -> Array:
        return np.asarray(np.tensordot(self._of(kind), polynomials(kind), 1))
