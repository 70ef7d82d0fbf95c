"""A field of PSFs as patches with a few kernels each.

    image(X) = Σ_patches Σ_r kernel_r * [weight_r(x, z) source(x, z)]

The PSFs are known on a grid of nodes over the field (4-point Lagrange between them,
wherever they lie) and at depths
of equal steps of 1/z (likewise). In each patch the PSFs at a few places are one matrix
(places × depths, samples); its
leading singular vectors, seen through a 1/f texture, are the kernels. What the PSFs at
more places, as close as the
nodes, weigh in them is interpolated to every pixel. Patches overlap by a few pixels,
where their shares, which add up
to 1, are folded into the weights.
"""

import itertools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

TAPS = 4  # of the interpolation
PLACES = 5  # along an axis of a patch from whose PSFs the kernels are made


@dataclass(frozen=True, eq=False, slots=True)
class Patch:
    """One patch of the image.

    rows, columns: first pixel and the one behind the last, in the frame.
    share: (pixels,) of the patch in what a source gives; those of all patches add up to
    1.
    weights: (pixels, depths, rank) of the kernels for a source at each pixel and depth,
    whose light is the share.
    energy: (pixels, depths) relative illumination: light of a PSF.
    mix: (rank, nodes) rows of kernels over :attr:`nodes`; kernels = mix @ PSFs of the
    nodes.
    nodes: (nodes,) indices (row, column, depth, flattened) of the PSFs it is made of.
    missing: (kernels + 1,) relative L2 error of the image of a 1/f texture through so
    many of the kernels, at the worst
        depth, if it were the same at all pixels as bright as the patch's brightest.
    coverage: kernels that coverage takes.
    """

    rows: tuple[int, int]
    columns: tuple[int, int]
    share: Tensor
    weights: Tensor
    energy: Tensor
    mix: Tensor
    nodes: Tensor
    missing: Tensor
    coverage: int

    def to(self, device: torch.device | str) -> "Patch":
        """The same on a device."""
        parts = ("share", "weights", "energy", "mix", "nodes", "missing")
        return replace(self, **{name: getattr(self, name).to(device) for name in parts})

    def trimmed(self, tolerance: float, coverage: float) -> "Patch":
        """The first kernels alone, as many as the tolerances of light and of coverage
        need.
        """
        rank, few = (
            max(int((self.missing > t).sum()), 1) for t in (tolerance, coverage)
        )
        rank = min(rank, len(self.mix))
        weights = _lit(self.weights[..., :rank], self.mix[:rank], self.share)
        return replace(
            self, weights=weights, mix=self.mix[:rank], coverage=min(few, rank)
        )


def _lit(weights: Tensor, mix: Tensor, share: Tensor) -> Tensor:
    """The weights scaled so that a source's kernels hold its share of light, as the
    PSFs that they stand for (sum 1).

    What few kernels lack of a PSF is light, too, and other light at every depth.
    Kernels that hold less than half of it
    show something else, and stay as they are.
    """
    held, whole = weights @ mix.sum(1), share[:, None]
    scale = torch.where(held > whole / 2, whole / held, 1.0)
    return depths_first(weights * scale[..., None])


def depths_first(table: Tensor) -> Tensor:
    """The same (pixels, depths, …), but pixels lie side by side in memory: compiled
    loops run along them.
    """
    return table.movedim(0, -1).contiguous().movedim(-1, 0)


def lagrange(wanted: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """First node and weights (…, TAPS) of the 4-point interpolation at positions in
    units of the nodes, 0 … count - 1.

    At the ends the outermost four nodes serve; fewer nodes than four take what there is
    (a polynomial of their number).
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


def dense(wanted: Tensor, nodes: Tensor) -> Tensor:
    """(n, nodes) weights of the 4-point Lagrange interpolation at (n,) places between
    ascending nodes.

    As :func:`lagrange`, for nodes at any distances.
    """
    taps, last = min(TAPS, len(nodes)), len(nodes) - 1
    first = (torch.searchsorted(nodes, wanted, right=True) - taps // 2).clamp(
        0, last + 1 - taps
    )
    index = first[:, None] + torch.arange(taps, device=nodes.device)
    at = nodes[index]
    weights = torch.ones_like(at)
    for i in range(taps):
        for j in range(taps):
            if j != i:
                weights[:, i] *= (wanted - at[:, j]) / (at[:, i] - at[:, j])
    return torch.zeros(
        len(wanted), len(nodes), dtype=at.dtype, device=at.device
    ).scatter_(1, index, weights)


def texture_view(kernels: Tensor) -> Tensor:
    """(PSFs, features) transfer functions as a 1/f texture shows them; its L2 norm is
    that of the texture's image.
    """
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


def together(one: Tensor, other: Tensor) -> float:
    """Relative L2 difference of the images of a 1/f texture through PSFs (places,
    depths, h, w), each as bright as its
    light, over all places, at the worst depth; over what the brightest depth shows."""
    a, b = texture_view(one.double()), texture_view(other.double())
    return float(
        torch.sqrt(((a - b) ** 2).sum((0, -1)).max() / (b**2).sum((0, -1)).max())
    )


def in_light(errors: Tensor, light: Tensor) -> float:
    """Root mean square of the relative errors of PSFs (places, depths), each as bright
    as its light, over the brightest
    place: what is dark shows little."""
    return float(((errors * light / light.amax(0)) ** 2).mean().sqrt())


def shares(pixels: int, count: int, overlap: int) -> list[tuple[int, int, Tensor]]:
    """(first, behind the last, share) of ``count`` patches along an axis; the shares of
    a pixel add up to 1.
    """
    count = max(1, min(count, pixels // max(2 * overlap, 1)))
    edges = [pixels * i // count for i in range(count + 1)]
    place = torch.arange(pixels, dtype=torch.float64) + 0.5
    ramps = [_ramp((place - edge) / max(overlap, 1e-9)) for edge in edges]
    out = []
    for i in range(count):
        low = max(edges[i] - (overlap + 1) // 2, 0) if i else 0
        high = (
            min(edges[i + 1] + (overlap + 1) // 2, pixels) if i < count - 1 else pixels
        )
        up = ramps[i] if i else torch.ones_like(place)
        down = 1 - ramps[i + 1] if i < count - 1 else torch.ones_like(place)
        out.append((low, high, (up * down)[low:high]))
    return out


def _ramp(position: Tensor) -> Tensor:
    """0 below -1/2, 1 above 1/2, a sine squared between."""
    return torch.sin((position.clamp(-0.5, 0.5) + 0.5) * (math.pi / 2)) ** 2


def cut(
    stack: Tensor,
    energy: Tensor,
    grid: list[Tensor],
    *,
    patches: int,
    overlap: int,
    tolerance: float,
) -> list[Patch]:
    """Patches of a field of PSFs.

    Args:
        stack: (node rows, node columns, depths, h, w), each of sum 1.
        energy: (node rows, node columns, depths) light of each.
        grid: (pixel rows, node rows) and (pixel columns, node columns) of
            :func:`dense`.
        patches: along each axis. overlap: pixels that two neighbours share.
        tolerance: of the image of a 1/f texture, relative L2, at the worst depth of
            every patch.
    """
    rows, columns = (
        [_line(part, *one) for one in shares(len(part), patches, overlap)]
        for part in grid
    )
    pairs = list(itertools.product(rows, columns))
    known = Products(
        texture_view(stack.detach().double()),
        [len(y.nodes) * len(x.nodes) for y, x in pairs],
    )
    return [_patch(known, energy, line, tolerance) for line in pairs]


class Line(NamedTuple):
    """A patch along one axis.

    ends: first pixel and the one behind the last. share: of them. between: (pixels,
    nodes) interpolation from the nodes
    of these numbers. few: rows of it from whose PSFs the kernels are made; many: whose
    weights are interpolated, at
    pixels ``at``.
    """

    ends: tuple[int, int]
    share: Tensor
    between: Tensor
    nodes: Tensor
    few: Tensor
    many: Tensor
    at: Tensor


def _line(grid: Tensor, first: int, behind: int, share: Tensor) -> Line:
    inside = grid[first:behind]
    nodes = torch.nonzero(inside.abs().amax(0) > 0)[:, 0]
    inside = inside[:, nodes]
    few, many = (
        _places(len(inside), count) for count in (PLACES, max(PLACES, len(nodes)))
    )
    return Line((first, behind), share, inside, nodes, inside[few], inside[many], many)


class Products:
    """Scalar products of the nodes' PSFs as a texture shows them: all that patches are
    made of, since PSFs between the
    nodes are mixtures of theirs.

    All products at once where that is less work than those of every patch, whose nodes
    are shared with its neighbours.
    """

    def __init__(self, seen: Tensor, counts: list[int]) -> None:
        """``seen``: (node rows, node columns, depths, features). ``counts``: nodes of
        every patch.
        """
        self.seen, self.depths, self.columns = (
            seen.flatten(0, 2),
            seen.shape[2],
            seen.shape[1],
        )
        apart = sum((count * self.depths) ** 2 for count in counts)
        self.whole = self.seen @ self.seen.mT if len(self.seen) ** 2 <= apart else None

    def of(self, nodes: Tensor) -> Tensor:
        """(nodes, depths, nodes, depths) of some nodes, all depths: those of their flat
        numbers.
        """
        if self.whole is not None:
            found = self.whole[nodes[:, None], nodes]
        else:
            near = self.seen[nodes]
            found = near @ near.mT
        shape = 2 * (len(nodes) // self.depths, self.depths)
        products: Tensor = found.reshape(shape)
        return products


def _patch(
    known: Products, energy: Tensor, lines: tuple[Line, Line], tolerance: float
) -> Patch:
    """Leading singular vectors of the PSFs at a few places of a patch, and what they
    weigh at every pixel and depth.
    """
    seen, depths = known.seen, known.depths
    along = [
        Line(line.ends, *(part.to(seen.device) for part in line[1:])) for line in lines
    ]
    share = (along[0].share.to(seen)[:, None] * along[1].share.to(seen)).flatten()
    nodes = _flat([line.nodes for line in along], known.columns, depths)
    few, many = (
        torch.kron(*(getattr(line, name).to(seen) for line in along))
        for name in ("few", "many")
    )
    to_few = torch.einsum(
        "uzsw,ps->uzpw", known.of(nodes), few
    )  # the nodes' PSFs with those at the places
    values, vectors = torch.linalg.eigh(
        torch.einsum("uzpw,qu->qzpw", to_few, few).flatten(2).flatten(0, 1)
    )
    values, vectors = (
        values.flip(0).clamp_min(1e-14 * float(values[-1])),
        vectors.flip(1),
    )
    power = (vectors**2 * values).reshape(-1, depths, len(values)).mean(0)
    lit = energy[along[0].nodes][:, along[1].nodes].to(seen)
    lit = torch.einsum(
        "ya,xb,abz->yxz", *(line.between.to(seen) for line in along), lit
    ).flatten(0, 1)
    bright = (lit.detach().max() / energy.detach().max()).clamp(0, 1)
    missing = bright * torch.sqrt(
        power.flip(1).cumsum(1).flip(1) / power.sum(1, keepdim=True)
    ).amax(0)
    rank = max(int((missing > tolerance).sum()), 1)
    left = vectors[:, :rank]
    weighed = torch.einsum(
        "uzr,qu->qzr", to_few.flatten(2) @ (left / values[:rank]), many
    )
    table = weighed.reshape(*(len(line.at) for line in along), depths, rank)
    table = torch.einsum(
        "yp,xq,pqzr->yxzr", *(_to_pixels(line).to(seen) for line in along), table
    )
    table = table.flatten(0, 1) * share[:, None, None]
    mix = torch.einsum("qu,qzr->ruz", few, left.reshape(-1, depths, rank)).flatten(1)
    return Patch(
        along[0].ends,
        along[1].ends,
        share.float(),
        _lit(table, mix, share).float(),
        depths_first(lit.float()),
        mix.float(),
        nodes,
        torch.cat([missing, missing.new_zeros(1)])[: rank + 1],
        rank,
    )


def _to_pixels(line: Line) -> Tensor:
    """(pixels, many) interpolation from the places whose weights are known."""
    pixel = torch.arange(len(line.between), dtype=torch.float64, device=line.at.device)
    return dense(pixel, line.at.double())


def _places(pixels: int, count: int) -> Tensor:
    """(count,) pixels of a patch from its first to its last, at most all of them."""
    return (
        torch.linspace(0, pixels - 1, min(count, pixels), dtype=torch.float64)
        .round()
        .long()
    )


def _flat(touched: list[Tensor], columns: int, depths: int) -> Tensor:
    """Indices of some rows and columns of nodes, all depths, in the flattened stack."""
    deep = torch.arange(depths, device=touched[0].device)
    return (
        ((touched[0][:, None] * columns + touched[1])[..., None] * depths) + deep
    ).flatten()
