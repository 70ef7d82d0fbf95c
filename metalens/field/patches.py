"""A field of PSFs as patches with a few kernels each.

    image(X) = Σ_patches Σ_r kernel_r * [weight_r(x, z) source(x, z)]

The PSFs are known on a grid of nodes over the field (4-point Lagrange between them) and at depths of equal steps of
1/z (likewise). In each patch the nodes that touch it are one matrix (nodes × depths, samples); its leading singular
vectors, seen through a 1/f texture, are the kernels, and their coefficients are interpolated to every pixel. Patches
overlap by a few pixels, where their shares, which add up to 1, are folded into the weights.
"""

import itertools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

TAPS = 4  # of the interpolation
PLACES = 5  # along an axis of a patch at which its PSFs are compared


@dataclass(frozen=True, eq=False, slots=True)
class Patch:
    """One patch of the image.

    rows, columns: first pixel and the one behind the last, in the frame.
    weights: (pixels, depths, rank) of the kernels for a source at each pixel and depth, the patch's share included.
    energy: (pixels, depths) relative illumination: light of a PSF.
    mix: (rank, nodes) rows of kernels over :attr:`nodes`; kernels = mix @ PSFs of the nodes.
    nodes: (nodes,) indices (row, column, depth, flattened) of the PSFs it is made of.
    missing: (kernels + 1,) relative L2 error of the image of a 1/f texture through so many of the kernels, at the worst
        depth, if it were the same at all pixels.
    coverage: kernels that coverage takes.
    """

    rows: tuple[int, int]
    columns: tuple[int, int]
    weights: Tensor
    energy: Tensor
    mix: Tensor
    nodes: Tensor
    missing: Tensor
    coverage: int

    def trimmed(self, tolerance: float, coverage: float) -> "Patch":
        """The first kernels alone, as many as the tolerances of light and of coverage need."""
        rank, few = (max(int((self.missing > t).sum()), 1) for t in (tolerance, coverage))
        rank = min(rank, len(self.mix))
        weights = self.weights[..., :rank].contiguous()
        return replace(self, weights=weights, mix=self.mix[:rank], coverage=min(few, rank))


def lagrange(wanted: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """First node and weights (…, TAPS) of the 4-point interpolation at positions in units of the nodes, 0 … count - 1.

    At the ends the outermost four nodes serve; fewer nodes than four take what there is (a polynomial of their number).
    """
    taps = min(TAPS, count)
    first = (wanted.floor() - (taps // 2 - 1)).clamp(0, count - taps)
    offset = wanted - first
    weights = []
    for i in range(taps):
        w = torch.ones_like(offset)
        for j in range(taps):
            if j != i:
                w = w * (offset - j) / (i - j)
        weights.append(w)
    return first.long(), torch.stack(weights, -1)


def dense(wanted: Tensor, count: int) -> Tensor:
    """(…, count) the weights of :func:`lagrange` on all nodes."""
    first, weights = lagrange(wanted, count)
    out = torch.zeros(*wanted.shape, count, dtype=wanted.dtype, device=wanted.device)
    return out.scatter_(-1, first[..., None] + torch.arange(weights.shape[-1], device=wanted.device), weights)


def texture_view(kernels: Tensor) -> Tensor:
    """(PSFs, features) transfer functions as a 1/f texture shows them; its L2 norm is that of the texture's image."""
    h, w = kernels.shape[-2:]
    size = (2 * h, 2 * w)
    fy = torch.fft.fftfreq(size[0], dtype=kernels.dtype, device=kernels.device)
    fx = torch.fft.rfftfreq(size[1], dtype=kernels.dtype, device=kernels.device)
    amplitude = 1 / torch.sqrt(fy[:, None] ** 2 + fx**2 + (1 / (8 * max(h, w))) ** 2)
    amplitude = amplitude * torch.where((fx == 0) | (fx == 0.5), 1.0, 2**0.5)
    return torch.view_as_real(torch.fft.rfft2(kernels, s=size) * amplitude).flatten(-3)


def relative(one: Tensor, other: Tensor) -> Tensor:
    """(…) relative L2 difference of the images of a 1/f texture through PSFs (…, h, w)."""
    a, b = texture_view(one.double()), texture_view(other.double())
    difference: Tensor = (a - b).norm(dim=-1) / b.norm(dim=-1)
    return difference


def shares(pixels: int, count: int, overlap: int) -> list[tuple[int, int, Tensor]]:
    """(first, behind the last, share) of ``count`` patches along an axis; the shares of a pixel add up to 1."""
    count = max(1, min(count, pixels // max(2 * overlap, 1)))
    edges = [pixels * i // count for i in range(count + 1)]
    place = torch.arange(pixels, dtype=torch.float64) + 0.5
    ramps = [_ramp((place - edge) / max(overlap, 1e-9)) for edge in edges]
    out = []
    for i in range(count):
        low = max(edges[i] - (overlap + 1) // 2, 0) if i else 0
        high = min(edges[i + 1] + (overlap + 1) // 2, pixels) if i < count - 1 else pixels
        up = ramps[i] if i else torch.ones_like(place)
        down = 1 - ramps[i + 1] if i < count - 1 else torch.ones_like(place)
        out.append((low, high, (up * down)[low:high]))
    return out


def _ramp(position: Tensor) -> Tensor:
    """0 below -1/2, 1 above 1/2, a sine squared between."""
    return torch.sin((position.clamp(-0.5, 0.5) + 0.5) * (math.pi / 2)) ** 2


def cut(
    stack: Tensor, energy: Tensor, frame: tuple[int, int], *, patches: int, overlap: int, tolerance: float
) -> list[Patch]:
    """Patches of a field of PSFs.

    Args:
        stack: (node rows, node columns, depths, h, w), each of sum 1; the nodes run from the first to the last pixel.
        energy: (node rows, node columns, depths) light of each.
        frame: (y, x) pixels. patches: along each axis. overlap: pixels that two neighbours share.
        tolerance: of the image of a 1/f texture, relative L2, at the worst depth of every patch.
    """
    along = [shares(n, patches, overlap) for n in frame]
    grid = [
        dense(torch.linspace(0, k - 1, n, dtype=torch.float64), k) for n, k in zip(frame, stack.shape, strict=False)
    ]
    seen = texture_view(stack.detach().double())
    return [_patch(seen, energy, grid, row, column, tolerance) for row, column in itertools.product(*along)]


def _patch(
    seen: Tensor,
    energy: Tensor,
    grid: list[Tensor],
    row: tuple[int, int, Tensor],
    column: tuple[int, int, Tensor],
    tolerance: float,
) -> Patch:
    """Leading singular vectors of the PSFs at a few places of a patch, and what they weigh at every pixel and depth."""
    in_y, in_x = (g[a:b].to(seen) for g, (a, b, _) in zip(grid, (row, column), strict=True))
    places = [torch.linspace(0, len(part) - 1, PLACES).round().long() for part in (in_y, in_x)]
    at_y, at_x = (part[where] for part, where in zip((in_y, in_x), places, strict=True))
    touched = [torch.nonzero(part.abs().amax(0) > 0)[:, 0] for part in (at_y, at_x)]
    at_y, at_x = at_y[:, touched[0]], at_x[:, touched[1]]
    near = seen[touched[0]][:, touched[1]]
    depths = near.shape[2]
    rows = torch.einsum("pa,qb,abzf->pqzf", at_y, at_x, near).flatten(0, 2)
    values, vectors = torch.linalg.eigh(rows @ rows.mT)
    vectors = vectors.flip(1)
    power = (vectors**2 * values.flip(0).clamp_min(0)).reshape(-1, depths, len(values)).mean(0)
    missing = torch.sqrt(power.flip(1).cumsum(1).flip(1) / power.sum(1, keepdim=True)).amax(0)
    rank = max(int((missing > tolerance).sum()), 1)
    left = vectors[:, :rank].reshape(PLACES, PLACES, depths, rank)
    share = row[2].to(seen)[:, None] * column[2].to(seen)
    to_y, to_x = (_between(where, len(part)) for where, part in zip(places, (in_y, in_x), strict=True))
    table = torch.einsum("yp,xq,pqzr->yxzr", to_y.to(seen), to_x.to(seen), left)
    light = torch.einsum("ya,xb,abz->yxz", in_y, in_x, energy.to(seen))
    mix = torch.einsum("pa,qb,pqzr->rabz", at_y, at_x, left)
    index = (touched[0][:, None] * seen.shape[1] + touched[1])[..., None] * depths + torch.arange(
        depths, device=seen.device
    )
    return Patch(
        (row[0], row[1]),
        (column[0], column[1]),
        (table * share[..., None, None]).flatten(0, 1).float(),
        light.flatten(0, 1).float(),
        mix.flatten(1).float(),
        index.flatten(),
        torch.cat([missing, missing.new_zeros(1)])[: rank + 1],
        rank,
    )


def _between(places: Tensor, pixels: int) -> Tensor:
    """(pixels, places) polynomial through all places."""
    at, x = torch.arange(pixels, dtype=torch.float64)[:, None], places.double()
    columns = []
    for i in range(len(x)):
        others = torch.cat([x[:i], x[i + 1 :]])
        columns.append(((at - others) / (x[i] - others)).prod(1))
    return torch.stack(columns, 1)
