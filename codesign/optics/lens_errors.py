"""Fabrication and assembly errors of lenses that training draws, and their effect
on phase.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from metalens import library
from metalens.cell import Cell
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.fabrication import DRAWN, Draw, State, effective_indices, response_errors
from metalens.library import Proxy

ASSEMBLY = ("focus_um", "tilt_waves", "astigmatism_waves")
# plain round pillars have no turn, pedestal or cap
ENTRIES = (
    *ASSEMBLY,
    *(n for n in DRAWN if n not in ("turn_deg", "pedestal_nm", "cap_nm")),
)
_Entries: Any = dataclasses.make_dataclass(
    "_Entries", [(name, float, 0.0) for name in ENTRIES], frozen=True
)


@dataclass(frozen=True)
class LensErrors(_Entries):  # type: ignore[misc]
    """Fabrication and assembly errors drawn during training, so that the lens stands
    them (standard deviations).

    focus_um: error of the lens-sensor distance. tilt_waves: coma-like phase of a tilted
    lens, waves at the rim.
    astigmatism_waves: of stress and stage errors, waves at the rim. Then what a process
    spreads, in the names of :class:`metalens.fabrication.Spread`.
    bias_nm: mean of the diameters. height_nm: of the pillars. gradient_nm: of
    the bias from edge to edge. bow_nm: from axis to rim. index: of the pillars. sidewall_deg: lean of
    their walls.
    width_nm, length_nm: of all pillars along x and y alone.
    """

    def __post_init__(self) -> None:
        if min(self.deviations) < 0:
            raise ConfigError(
                f"spread {self.deviations}: need standard deviations of 0 or more"
            )

    @property
    def deviations(self) -> tuple[float, ...]:
        """Standard deviations in order."""
        return tuple(float(getattr(self, name)) for name in ENTRIES)

    def draw(self, generator: torch.Generator) -> "DrawnLensErrors | None":
        """Independent normal errors of one lens; None where nothing varies.

        The direction of gradients is uniform over a turn.

        Args:
            generator: of the draws.
        """
        if not any(self.deviations):
            return None
        draws = torch.randn(len(ENTRIES), generator=generator, dtype=torch.float64)
        turn = float(torch.rand(1, generator=generator, dtype=torch.float64))
        amounts = draws * torch.tensor(self.deviations, dtype=torch.float64)
        named = zip(ENTRIES, amounts.tolist(), strict=True)
        return DrawnLensErrors(dict(named), 2 * math.pi * turn)


@dataclass(frozen=True, slots=True)
class DrawnLensErrors:
    """One lens: amounts by entry of :data:`ENTRIES` (left out: 0), and the direction of
    its gradients.
    """

    amounts: Mapping[str, float]
    turn_rad: float = 0.0

    def state(self) -> State:
        """What the process did to it."""
        return Draw(
            {n: a for n, a in self.amounts.items() if n in DRAWN}, self.turn_rad
        ).state()

    def assembly(self) -> tuple[float, ...]:
        """Amounts of :data:`ASSEMBLY`."""
        return tuple(self.amounts.get(name, 0.0) for name in ASSEMBLY)


@dataclass(frozen=True, eq=False, slots=True)
class PhaseRates:
    """How the phases of a cell's pillars change with the process, over a turn of phase.

    mean: (1 + causes,) of d phase / d(diameter, answering causes), base units.
    covariance: (1 + causes, 1 + causes) of the same.
    """

    mean: Array
    covariance: Array


def wave_front_rad(state: State, u: Tensor, v: Tensor, rates: PhaseRates) -> Tensor:
    """Wave front error that all pillars share, rad: mean phase of the bias, and
    aberrations.

    The phase of the bias relative to that at the centre.

    Args:
        state: perturbations by the process. u: x over the radius of the lens.
        v: y over the radius of the lens. rates: phase rates of the unit cell.
    """
    x, y = u.cpu().numpy(), v.cpu().numpy()
    mean_phase = rates.mean[0] * (
        state.bias_um(x, y) - state.bias_um(np.zeros(1), np.zeros(1))
    )
    return torch.from_numpy(mean_phase + state.phase_rad(x, y)).to(u.device)


def variance_rad2(state: State, rates: PhaseRates) -> float:
    """Variance of the pillar phases about their shared wave front, rad².

    Mean over the aperture of r^T C r, r the bias and the other causes, C the covariance
    of the phase rates. By Gauss nodes over the squared radius: exact for polynomials.

    Args:
        state: perturbations by the process. rates: phase rates of the unit cell.
    """
    node, weight = np.polynomial.legendre.leggauss(12)
    radius = np.sqrt((node[:, None] + 1) / 2)
    angle = np.arange(24) * (math.pi / 12)
    bias = state.bias_um(radius * np.cos(angle), radius * np.sin(angle))
    amounts = state.response_amounts()
    # means over the aperture of the bias and its square
    mean, square = (float(weight @ power.mean(1)) / 2 for power in (bias, bias**2))
    covariance = rates.covariance
    return float(
        covariance[0, 0] * square
        + 2 * mean * (covariance[0, 1:] @ amounts)
        + amounts @ covariance[1:, 1:] @ amounts
    )


@functools.lru_cache(maxsize=8)
def pillar_proxy(cell: Cell, wavelength_um: float) -> Proxy:
    """Phase and transmission of a cell's pillars as functions of their diameter, from
    a solved library (paper Eq. 2).

    Args:
        wavelength_um: of the light.
    """
    return library.proxy_of(library.sweep(cell, wavelengths_um=(wavelength_um,)))


@functools.lru_cache(maxsize=8)
def phase_rates(cell: Cell, wavelength_um: float) -> PhaseRates:
    """Mean and covariance of the phase rates of a cell's pillars at a wavelength.

    Over 400 pillars whose phases are evenly spaced over a turn.

    Args:
        cell: unit cell. wavelength_um: of the light.

    Accuracy: by the diameter as the proxy, 1 %; by the other causes as an effective
    index, 5 % of the covariance with height.
    """
    proxy = pillar_proxy(cell, wavelength_um)
    first_phase = proxy.phase_rad(np.array([proxy.domain_um[0]]), wavelength_um)[0]
    phases = first_phase + np.linspace(0, 2 * math.pi, 400, endpoint=False)
    diameter = np.asarray(proxy.diameter_um(phases, wavelength_um))
    indices = effective_indices(cell, proxy, wavelength_um, diameter)
    cause_rates = [cause.quick(indices).imag for _, cause in response_errors()]
    rates = np.stack([proxy.dphase_ddiameter(diameter, wavelength_um), *cause_rates])
    return PhaseRates(rates.mean(1), np.cov(rates))
