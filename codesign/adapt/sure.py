"""Whether an as-built lens is known well enough to correct the next mask by it, and what would settle it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from characterize.inference import AsBuilt
from metalens.ground.arrays import Array
from metalens.ground.errors import ConfigError

DRAWS = 24
WIDE_NM = 2.0  # standard deviation of the table's entries beyond which it is no table: the step of drawn diameters


@dataclass(frozen=True, eq=False, slots=True)
class Sureness:
    """How the posterior spreads a bias table.

    table_nm: (draws, knots) the table of every draw. sigma_nm: (knots,) its standard deviation. words: why it is
    refused, and what to capture or measure; empty where it may be used.
    """

    table_nm: Array
    sigma_nm: Array
    words: str

    @property
    def usable(self) -> bool:
        """Whether the posterior is narrow enough."""
        return not self.words


def judge(result: AsBuilt, table: Callable[[Array], Array], *, wide_nm: float = WIDE_NM, seed: int = 5) -> Sureness:
    """The table that every draw of the posterior would ask for, and whether they agree.

    Args:
        table: (knots,) bias table of all parameters of one lens.
    """
    try:
        drawn = np.array([table(result.parameters(row)) for row in result.samples(DRAWS, seed=seed)])
    except ConfigError as refusal:
        return Sureness(np.empty((0, 0)), np.empty(0), f"no correction: for lenses of the posterior {refusal}")
    sigma = drawn.std(axis=0, ddof=1)
    if sigma.max() <= wide_nm:
        return Sureness(drawn, sigma, "")
    causes = [name for name in ("bias_nm", "height_nm", "index", "sidewall_deg", "bias_r_nm") if name in result.names]
    ranges = [(name, *result.interval(name)) for name in causes]
    told = ", ".join(f"{name} {low:.3g} to {high:.3g}" for name, low, high in ranges)
    return Sureness(
        drawn,
        sigma,
        f"no correction: the posterior leaves the bias table open by {sigma.max():.1f} nm (1 sigma, at most "
        f"{wide_nm:g} allowed; {told}). Settle it by frames at source depths on both sides of focus where the spot is "
        "several pixels wide (metalens capture lens.h5 --protocol lists the best), by frames at a field angle, by "
        "diameters from micrographs (metalens measure) or the height (AFM) as [[known]]",
    )
