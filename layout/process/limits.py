"""What a process prints, as limits on designed diameters: the inverse of bias, steps
and polygons.
"""

from pathlib import Path

import numpy as np

from layout.process.process import load_process
from layout.shapes import convex, polygon
from metalens.core.errors import ProcessError
from metalens.core.units import nm

_MOST_STEPS = 4000


def printable_limits(
    path: Path, *, pitch_um: float, height_um: float
) -> tuple[float, float]:
    """(thinnest pillar, least gap) in nm of designed pillars, so that what is drawn
    keeps the rules.

    Args:
        path: of PROCESS.toml.
        pitch_um: of the lattice.
        height_um: of the pillars.

    Raises:
        ConfigError, ProcessError: the file cannot be used; ProcessError: no diameter
            keeps both rules on this pitch.
    """
    process = load_process(path)
    rules = process.rules
    pitch = pitch_um / nm
    least = max(4 * rules.grid_nm, rules.diameter_step_nm)
    sizes = np.arange(
        least, min(pitch, least + _MOST_STEPS * rules.diameter_step_nm), 1
    )
    drawn = np.unique(-(-sizes // rules.diameter_step_nm) * rules.diameter_step_nm)
    drawn = drawn[(drawn >= 0.5 * rules.minimum_feature_nm) & (drawn < pitch)]
    shapes = [
        polygon.pillar_polygon(
            float(d) / rules.grid_nm, vertices=rules.vertices, shape=rules.shape
        ).points
        for d in drawn
    ]
    half = np.array([p[:, 0].max() for p in shapes]) * rules.grid_nm
    width = np.array([convex.least_width(p) for p in shapes]) * rules.grid_nm
    _, foot = process.top_foot_nm(
        process.made_diameter_nm(drawn) + max(0.0, process.bias.isolated_nm),
        height_um / nm,
    )
    thick = np.logical_and.accumulate((width >= rules.minimum_feature_nm)[::-1])[
        ::-1
    ]  # and every wider one
    apart = (pitch - 2 * half >= rules.minimum_gap_nm) & (
        pitch - foot >= rules.minimum_foot_gap_nm
    )
    fine = thick & np.logical_and.accumulate(apart)  # and every thinner one
    if not fine.any():
        raise ProcessError(
            f"{path}: no pillar keeps {rules.minimum_feature_nm:g} nm and leaves {rules.minimum_gap_nm:g} nm on a "
            f"pitch of {pitch:.4g} nm; widen the pitch or change the process"
        )
    step = rules.diameter_step_nm
    alone = process.bias.isolated_nm
    low = float(process.made_diameter_nm(drawn[fine][0] - 0.45 * step)) + max(
        0.0, alone
    )
    high = float(process.made_diameter_nm(drawn[fine][-1] + 0.45 * step)) + min(
        0.0, alone
    )
    return low, pitch - high
