"""A pillar that is turned alone: its Jones matrix is that of the unturned one in axes
that turn with it.
"""

import numpy as np


def isolated(t_x, t_y, angle_rad):
    """(..., 2, 2) R(θ) diag(t_x, t_y) R(-θ)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    off = (t_x - t_y) * c * s
    return np.stack(
        [
            np.stack([t_x * c**2 + t_y * s**2, off], -1),
            np.stack([off, t_x * s**2 + t_y * c**2], -1),
        ],
        -2,
    )
