"""What patches of few kernels make of even light, and how it is put right.

    even(X) = Σ_x E(x) P(X; x)  of the nodes' PSFs,  over the same sum through the
    patches

Few kernels of a patch hold its PSFs' light, but put some of them aside by a part of a
sample; where two patches meet
within a few samples, even light then shows a seam that no lens makes. One map over the
sensor, of the middle depth,
takes it out.
"""

import torch
from torch import Tensor

FAINT = 0.01  # of the most light: where there is less, nothing is put right


def light(stack: Tensor, energy: Tensor, between: list[Tensor]) -> Tensor:
    """(y, x) image of even light on a frame by the nodes' PSFs, dark beyond the frame.

    plain: I(X) = Σ_nodes E_node Σ_x to_y(x) to_x(x) P_node(X - x); both sums over x are
    products of matrices.

    Args:
        stack: (node rows, node columns, h, w) of sum 1. energy: (node rows, node
            columns).
        between: (pixel rows, node rows) and (pixel columns, node columns), by
            ``forming.between_nodes``.
    """
    across, along = (
        _seen(part.to(stack), size)
        for part, size in zip(between, stack.shape[-2:], strict=True)
    )
    lit = stack * energy.to(stack)[..., None, None]
    return (
        across @ lit.transpose(1, 2).reshape(across.shape[1], along.shape[1]) @ along.mT
    )


def _seen(to_pixels: Tensor, window: int) -> Tensor:
    """(pixels, nodes × window): what the sample of a node's PSF adds to a pixel from
    all sources of a line.
    """
    padded = torch.nn.functional.pad(to_pixels.mT, (window // 2, window // 2))
    return padded.unfold(1, window, 1).flip(-1).transpose(0, 1).flatten(1)


def ratio(wanted: Tensor, found: Tensor) -> Tensor:
    """wanted / found, and 1 where both are dark."""
    faint = FAINT * wanted.detach().abs().max()
    return 1 + found * (wanted - found) / (found**2 + faint**2)
