"""Low-rank PSF fields: a stack over depth (and field angle) as a few basis PSFs with
weights, and a certified error.
"""

from dataclasses import dataclass
from typing import Any

import torch

from metalens.core.errors import PropagationError
from metalens.psf import PsfStack


@dataclass(frozen=True, eq=False, slots=True)
class LowRank:
    """PSF of entry i ≈ Σ_r weights[i, r] · basis[r].

    weights: (…, depth, r); basis: (r, y, x), orthogonal; of the kind that came in.
    errors: (…, depth) relative L2 error of every PSF, computed, not estimated.
    error: of the whole stack; tolerance: that was asked of every PSF.
    """

    weights: Any
    basis: Any
    errors: Any
    error: float
    tolerance: float

    @property
    def rank(self) -> int:
        """Number of basis PSFs."""
        return int(self.basis.shape[0])

    def psf(self) -> Any:
        """(…, depth, y, x) the approximate stack."""
        flat = self.weights @ self.basis.reshape(self.rank, -1)
        return flat.reshape(*self.weights.shape[:-1], *self.basis.shape[1:])

    def at(self, weights: Any) -> Any:
        """(…, y, x) PSF for weights (…, r), such as those mixed from two neighbouring
        depths.
        """
        flat = weights @ self.basis.reshape(self.rank, -1)
        return flat.reshape(*weights.shape[:-1], *self.basis.shape[1:])


def compress(stack: PsfStack, *, tolerance: float = 1e-3) -> LowRank:
    """The fewest basis PSFs that bring every PSF of the stack within ``tolerance``
    (relative L2).

    Singular value decomposition of the PSFs, each scaled to unit norm so that blurred
    ones count as much as sharp
    ones. Sums stay right too: the weights reproduce Σ PSF = 1 within tolerance ·
    √pixels / (PSF norm) at worst; the
    returned errors are measured on the very weights and basis returned. The basis
    carries no gradient; the weights
    (and through them ``psf()``) do, as the projection of a differentiable stack.

    Raises:
        PropagationError: a tolerance that is not above 0.
    """
    if not tolerance > 0:
        raise PropagationError(f"tolerance is {tolerance}, need a number above 0")
    given = torch.as_tensor(stack.intensity)
    flat = given.reshape(-1, given.shape[-2] * given.shape[-1])
    fixed = flat.detach().double()
    norm = torch.linalg.vector_norm(fixed, dim=1, keepdim=True)
    u, size, v = torch.linalg.svd(fixed / norm, full_matrices=False)
    left = 1 - torch.cumsum((u * size) ** 2, dim=1)
    enough = (left.clamp_min(0).sqrt() <= 0.9 * tolerance).all(0)
    rank = int(torch.nonzero(enough)[0, 0]) + 1 if bool(enough.any()) else size.numel()
    basis = v[:rank].to(flat.dtype)
    weights = flat @ basis.T
    rest = torch.linalg.vector_norm((weights.detach() @ basis).double() - fixed, dim=1)
    errors = (rest / norm[:, 0]).reshape(given.shape[:-2])
    whole = float(torch.linalg.vector_norm(rest) / torch.linalg.vector_norm(fixed))
    parts: tuple[Any, Any, Any] = (
        weights.reshape(*given.shape[:-2], rank),
        basis.reshape(rank, *given.shape[-2:]),
        errors,
    )
    if not isinstance(stack.intensity, torch.Tensor):
        parts = parts[0].numpy(), parts[1].numpy(), parts[2].numpy()
    return LowRank(*parts, error=whole, tolerance=tolerance)
