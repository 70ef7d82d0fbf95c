"""Field-varying PSFs as one low-rank sum over the whole field and all depths."""

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag, pad

from metalens.image.scene import DeviceRecord
from metalens.image.splines import (
    TAPS,
    depth_position,
    spline_coefficients,
    spline_matrix,
    spline_taps,
)
from metalens.image.texture import scene_spectrum

CODES = 4096  # depths of a shift-invariant table, at equal steps of 1/z
SAMPLED = 1024  # node PSFs, drawn at random, of which the kernels are mixtures
FEWEST = 24  # kernels: single points hold more fine detail than a textured scene
FAINT = 0.01  # of the brightest sample: darker ones of a plane are not corrected
SMOOTH = 0.0025  # change of a plane at most: half the error between nodes
EVEN = 1e-3  # error of uniformly illuminated planes, a tenth of what shows


@dataclass(frozen=True, eq=False, slots=True)
class PsfField:
    """PSFs at nodes: equal steps over a frame from corner to corner, and of 1/z.

    psf: (rows, columns, depths, h, w), each of sum 1; h and w odd.
    illumination: (rows, columns, depths) relative illumination, the light of each PSF.
    depths_um: (depths,) ascending.
    """

    psf: Tensor
    illumination: Tensor
    depths_um: Tensor

    @property
    def light(self) -> Tensor:
        """(rows, columns, depths, h, w) PSFs times their relative illumination."""
        return self.psf * self.illumination[..., None, None]

    @property
    def uniform(self) -> bool:
        """Whether one node stands for the whole field: shift-invariant PSFs."""
        return self.psf.shape[:2] == (1, 1)


@dataclass(frozen=True, eq=False, slots=True)
class KernelBasis(DeviceRecord):
    """How kernels are mixed of the PSFs of a field, and what they weigh at its nodes.

    mixture: (rank, sampled) of the PSFs of the nodes ``sampled`` (flat numbers).
    weights: (nodes, rank) projections of all nodes' PSFs, of sum 1.
    error: relative L2 error of the image of a texture, at the worst depth.
    """

    mixture: Tensor
    sampled: Tensor
    weights: Tensor
    error: float

    def kernels(self, psf: Tensor, rank: int) -> Tensor:
        """(rank, h, w) leading kernels mixed of PSFs (rows, columns, depths, h, w)."""
        some = psf.flatten(0, 2)[self.sampled]
        return torch.einsum("rn,nyx->ryx", self.mixture[:rank].to(some), some)


def principal_kernels(
    field: PsfField, frame: tuple[int, int], *, tolerance: float
) -> KernelBasis:
    """Fewest principal components of PSFs that image a textured scene and planes.

    The metric is the image of a scene of mean 1 with a 1/f texture, and that of an
    uniformly illuminated plane. Kernels are mixtures of at most :data:`SAMPLED` of the
    nodes' PSFs, since PSFs between nodes are mixtures of theirs. Components are
    eigenvectors of the Gram matrix of PSFs, each times its illumination.

    Args:
        field: sampled field or PSFs.
        frame: (y, x) samples over which the nodes reach.
        tolerance: relative L2 error of the image of the scene, at the worst depth; a
            plane errs by no more, and by 0.01 at most.
    """
    psf = field.psf.detach().flatten(0, 2)
    light = field.illumination.detach().flatten().double()
    # an error that differs from node to node has frequencies up to half their number
    band = max((k - 1) / (2 * n) for k, n in zip(field.psf.shape, frame, strict=False))

    def transform(some: Tensor) -> Tensor:
        if field.uniform:
            return scene_spectrum(some.double())
        return scene_spectrum(some.double(), max(tolerance / 0.01, 1.0), band)

    draw = torch.Generator().manual_seed(3)
    drawn = torch.randperm(len(psf), generator=draw)[:SAMPLED].sort().values
    sampled = drawn.to(psf.device)
    features = transform(psf[sampled]) * light[sampled, None]
    power, vectors = torch.linalg.eigh(features @ features.mT)
    power = power.flip(0)
    vectors = vectors.flip(1)
    # below this is the rounding of single precision, in which the PSFs are given
    rank = max(int((power > 1e-13 * power[0]).sum()), 1)
    rank = min(rank, 320)
    scaled = vectors[:, :rank] / power[:rank].clamp_min(1e-300).sqrt()
    axes = scaled.mT @ features
    weights, powers = [], []
    for some in torch.split(psf, SAMPLED):
        spectrum = transform(some)
        weights.append(spectrum @ axes.mT)
        powers.append(spectrum.square().sum(1, keepdim=True))
    weight = torch.cat(weights)
    depths = len(field.depths_um)
    in_light = light[:, None] ** 2
    explained = (weight**2 * in_light).reshape(-1, depths, rank).mean(0)
    total = (torch.cat(powers) * in_light).reshape(-1, depths, 1).mean(0)
    level = total if field.uniform else in_light.reshape(-1, depths).mean(0).max()
    missing = torch.sqrt(((total - explained.cumsum(1)).clamp_min(0) / level).amax(0))
    fewest = FEWEST
    if field.uniform:
        derivative_error = _derivative_error(features, vectors[:, :rank])
        fewest = int((derivative_error > 0.02).sum()) if field.psf.requires_grad else 1
    rank = min(max(int((missing > tolerance).sum()) + 1, fewest), rank)
    mixture = scaled.mT[:rank] * light[sampled]
    error = float(missing[rank - 1])
    return KernelBasis(mixture, sampled, weight[:, :rank].contiguous(), error)


def _derivative_error(features: Tensor, axes: Tensor) -> Tensor:
    """(components,) relative L2 error of the image's derivative by depth.

    Element k is the error without component k and all later components. Components that
    are weak in the PSFs can be strong in their change with depth.

    Args:
        features: (depths, frequencies) spectra of the PSFs.
        axes: (depths, components) orthonormal mixtures of them.
    """
    if len(features) < 2:
        return features.new_zeros(axes.shape[1])
    (change,) = torch.gradient(features, dim=0)
    power = (axes.mT @ change).square().sum(1)
    total = change.square().sum().clamp_min(1e-300)
    return torch.sqrt((1 - (power.cumsum(0) - power) / total).clamp_min(0))


@dataclass(frozen=True, eq=False, slots=True)
class LowRankPsfs(DeviceRecord):
    """PSFs Σ_r w_r(x, z) K_r(δ) of the samples of a frame.

    kernels: (rank, h, w).
    transfer: (rank, Y, X // 2 + 1) their transforms, of size ``shape`` = (Y, X).
    table: (y, x, depth coefficients, rank) B-spline coefficients in 1/z of the weights
        of every sample; (depths, rank) weights at equal steps of 1/z where all samples
        share them.
    vergence: (nearest, farthest) 1/z of the nodes.
    plane_error: relative RMS error of uniformly illuminated planes at the worst depth
        node. Between the nodes planes are splines of those at the nodes.
    """

    kernels: Tensor
    transfer: Tensor
    shape: tuple[int, int]
    table: Tensor
    vergence: tuple[float, float]
    plane_error: float = 0.0

    @property
    def uniform(self) -> bool:
        """Whether all samples share their weights."""
        return self.table.ndim == 2

    def weigh(self, content: Tensor, depth_um: Tensor) -> Tensor:
        """(rank, *batch, y, x) sources times their weights w_r(x, z).

        Args:
            content: (*batch, y, x) light or coverage of the sources.
            depth_um: of the same shape, or one that broadcasts. Depths beyond the nodes
                have the weights of the outermost.
        """
        return self.interpolate(depth_um).reshape(-1, *depth_um.shape) * content

    def interpolate(self, depth_um: Tensor) -> Tensor:
        """(rank, samples) weights w_r(x, z) by cubic B-splines in 1/z.

        A uniform table is read at the nearest of its equal steps of 1/z instead.

        Args:
            depth_um: (*batch, y, x) depths of the sources.
        """
        unit = depth_position(depth_um.flatten(), self.vergence)
        if self.uniform:
            code = (unit * (len(self.table) - 1) + 0.5).long()
            return self.table.mT.index_select(1, code)
        high, wide, coefficients, rank = self.table.shape
        nodes = 1 if self.vergence[0] == self.vergence[1] else coefficients - 2
        first, taps = spline_taps(unit, nodes)
        number = torch.arange(len(unit), device=unit.device) % (high * wide)
        index = number * coefficients + first
        indices = index[:, None] + torch.arange(TAPS, device=unit.device)
        table = self.table.reshape(-1, rank).to(taps)
        weights = embedding_bag(indices, table, per_sample_weights=taps, mode="sum")
        return weights.mT.contiguous()

    def convolve(self, sources: Tensor) -> Tensor:
        """(*batch, y, x) Σ_r K_r * s_r of (rank, *batch, y, x).

        Light that wraps around lands within half a window of the frame's border.
        """
        spectrum = torch.fft.rfft2(sources, s=self.shape)
        total = spectrum[0] * self.transfer[0]
        for part, kernel in zip(spectrum[1:], self.transfer[1:], strict=True):
            total = torch.addcmul(total, part, kernel)
        whole: Tensor = torch.fft.irfft2(total, s=self.shape)
        return whole[..., : sources.shape[-2], : sources.shape[-1]]

    def blur(self, content: Tensor, depth_um: Tensor) -> Tensor:
        """(frames, *sheets, y, x) blurred content, few frames at a time."""
        if content.device.type != "cpu":
            return self.convolve(self.weigh(content, depth_um))
        # as many frames as fit in 8 MB of weighted sources: memory stays bounded
        count = max(1, 2**21 // (len(self.kernels) * content[0].numel()))
        parts = zip(
            torch.split(content, count), torch.split(depth_um, count), strict=True
        )
        return torch.cat([self.convolve(self.weigh(*part)) for part in parts])


def low_rank_psfs(
    field: PsfField,
    basis: KernelBasis,
    frame: tuple[int, int],
    *,
    rank: int | None = None,
    illuminated: bool = True,
) -> LowRankPsfs:
    """Low-rank PSFs of all samples of a frame, from the PSFs of a field's nodes.

    Weights at the nodes are corrected so that the sum and centroid of every PSF are
    exact (:func:`match_moments`), then interpolated by splines. A flat-field factor
    keeps uniformly illuminated planes as the nodes' own PSFs image them, and full
    coverage 1 (:func:`correct_plane`).

    Args:
        field: differentiable in its illumination, and in its PSFs where it is uniform.
        basis: of this field, or of a similar one on the same nodes.
        frame: (y, x) samples.
        rank: kernels that are used, by default all.
        illuminated: whether the sources carry light; else the PSFs are of sum 1.
    """
    psf = field.psf if field.uniform else field.psf.detach()
    rank = len(basis.mixture) if rank is None else min(rank, len(basis.mixture))
    kernels = basis.kernels(psf, rank)
    shape = fast_shape(frame)
    weights = basis.weights[:, :rank]
    vergence = 1 / float(field.depths_um[0]), 1 / float(field.depths_um[-1])
    transfer = transfer_functions(kernels, shape)
    if field.uniform:
        weights = weights * field.illumination.flatten()[:, None].to(weights)
        table = depth_table(field.depths_um).to(weights) @ weights
        return LowRankPsfs(kernels, transfer, shape, table.to(psf), vergence)
    weights = match_moments(weights, kernels, psf.flatten(0, 2))
    weights = weights.to(psf).reshape(*psf.shape[:3], rank)
    if illuminated:
        weights = weights * field.illumination[..., None]
    maps = frame_maps(frame, psf.shape[:2], psf)
    values = torch.einsum("ya,abzr,xb->yxzr", maps[0], weights, maps[1])
    # in double precision: rounding must not decide where the iterations end
    sources = values.detach().movedim(-1, 0).double()
    planes = targets = torch.ones_like(sources[0].movedim(-1, 0))  # of full coverage
    if illuminated:
        planes = plane_images(field.light.detach(), maps).to(sources)
        targets = smooth_planes(planes, psf.shape, min(SMOOTH, basis.error / 3))
    corrected = [
        correct_plane(sources[..., z], kernels.to(sources), target)
        for z, target in enumerate(targets)
    ]
    factors, errors = zip(*corrected, strict=True)
    values = values * torch.stack(factors, -1)[..., None].to(values)
    to_coefficients = spline_coefficients(values.shape[2]).to(values)
    table = torch.einsum("cz,yxzr->yxcr", to_coefficients, values).contiguous()
    ripple = float((targets - planes).norm() / planes.norm())
    error = math.hypot(max(errors), ripple)
    return LowRankPsfs(kernels, transfer, shape, table, vergence, error)


def depth_table(depths_um: Tensor) -> Tensor:
    """(:data:`CODES`, depths) matrix of linear interpolation to equal steps of 1/z.

    Args:
        depths_um: (depths,) of the nodes, ascending.
    """
    vergence = -1 / depths_um.double().cpu().numpy()
    at = np.linspace(vergence[0], vergence[-1], CODES)
    columns = [np.interp(at, vergence, row) for row in np.eye(len(vergence))]
    return torch.from_numpy(np.stack(columns, 1))


def fast_shape(frame: tuple[int, int]) -> tuple[int, int]:
    """(Y, X) size of quick transforms, at least that of the frame."""
    y, x = (scipy.fft.next_fast_len(n, real=True) for n in frame)
    return int(y), int(x)


def frame_maps(
    frame: tuple[int, int], nodes: tuple[int, ...], like: Tensor
) -> list[Tensor]:
    """(y, node rows) and (x, node columns) spline matrices from nodes to samples.

    Args:
        frame: (y, x) samples.
        nodes: numbers of node rows and columns.
        like: tensor of the dtype and device of the result.
    """
    return [
        spline_matrix(torch.linspace(0, 1, n, dtype=torch.float64), count).to(like)
        for n, count in zip(frame, nodes, strict=True)
    ]


def correct_plane(
    sources: Tensor, kernels: Tensor, target: Tensor
) -> tuple[Tensor, float]:
    """(y, x) flat-field factor by which a uniformly illuminated plane stays uniform, and
    the relative RMS error that it leaves.

    Least squares of the plane's relative error by conjugate gradients (CGLS: Hestenes
    and Stiefel 1952), from a factor of 1, until no sample errs by more than
    :data:`EVEN`. Samples within half a window of the border, which lack light from
    beyond it, do not count.

    Args:
        sources: (rank, y, x) weights times illumination.
        kernels: (rank, h, w) low-rank kernels.
        target: (y, x) image of the plane.
    """
    rows, columns = target.shape
    h, w = kernels.shape[-2:]
    shape = fast_shape((rows + h - 1, columns + w - 1))
    transfer = transfer_functions(kernels, shape)
    faint = FAINT * target.abs().max()
    inside = slice(h // 2, rows - h // 2), slice(w // 2, columns - w // 2)
    scale = torch.zeros_like(target)
    scale[inside] = (target / (target**2 + faint**2))[inside]

    def image(factor: Tensor) -> Tensor:
        spectrum = (torch.fft.rfft2(sources * factor, s=shape) * transfer).sum(0)
        whole: Tensor = torch.fft.irfft2(spectrum, s=shape)
        return whole[:rows, :columns] * scale

    def adjoint(error: Tensor) -> Tensor:
        spectrum = torch.fft.rfft2(error * scale, s=shape) * transfer.conj()
        whole = torch.fft.irfft2(spectrum, s=shape)[:, :rows, :columns]
        return torch.sum(sources * whole, 0)

    factor = torch.ones_like(target)
    residual = target * scale - image(factor)
    direction = gradient = adjoint(residual)
    for _ in range(16):
        if float(residual.abs().max()) < EVEN:
            break
        change = image(direction)
        power = gradient.square().sum()
        step = power / change.square().sum().clamp_min(1e-30)
        factor = factor + step * direction
        residual = residual - step * change
        gradient = adjoint(residual)
        direction = gradient + gradient.square().sum() / power * direction
    error = (residual * target).norm() / target[inside].norm().clamp_min(1e-30)
    return factor, float(error)


def plane_images(light: Tensor, maps: list[Tensor]) -> Tensor:
    """(depths, y, x) images of uniformly illuminated planes at the depth nodes.

    I(X) = Σ_ab Σ_x down(y, a) across(x, b) light_ab(X - x): both sums over x are
    products of matrices.

    Args:
        light: (rows, columns, depths, h, w) PSFs times their illumination.
        maps: :func:`frame_maps`.
    """
    spread = []
    for matrix, size in zip(maps, light.shape[-2:], strict=True):
        padded = pad(matrix.mT, (size // 2, size // 2))
        spread.append(padded.unfold(1, size, 1).flip(-1))  # (nodes, samples, window)
    planes = []
    for z in range(light.shape[2]):
        rows = torch.einsum("ayh,abhw->ybw", spread[0], light[:, :, z])
        planes.append(torch.einsum("ybw,bxw->yx", rows, spread[1]))
    return torch.stack(planes)


def smooth_planes(planes: Tensor, nodes: torch.Size, error: float) -> Tensor:
    """(depths, y, x) planes smoothed by least squares with the fewest splines.

    The image of a uniformly illuminated plane is smooth, but sums over samples and
    splines between nodes add a ripple of 0.1 to 0.2 % rms. Splines are fitted where all
    light reaches.

    Args:
        planes: (depths, y, x) images of uniformly illuminated planes.
        nodes: (rows, columns, depths, h, w) of the PSFs.
        error: relative RMS change of a plane that is allowed.
    """
    frame = planes.shape[1], planes.shape[2]
    inside = [
        slice(n // 2, size - n // 2) for n, size in zip(nodes[-2:], frame, strict=True)
    ]
    plane = planes[:, inside[0], inside[1]]
    for most in range(TAPS, max(nodes[:2])):
        fewer = tuple(min(most, n) for n in nodes[:2])
        rows, columns = (
            matrix[some] @ torch.linalg.pinv(matrix[some])
            for matrix, some in zip(
                frame_maps(frame, fewer, planes), inside, strict=True
            )
        )
        smooth = rows @ plane @ columns
        change = (smooth - plane).square().mean((1, 2)) / plane.square().mean((1, 2))
        if float(change.max()) < error**2:
            planes = planes.clone()
            planes[:, inside[0], inside[1]] = smooth
            break
    return planes


def psf_moments(psf: Tensor) -> Tensor:
    """(n, [sum, x, y]) sum and first moments of PSFs, lengths in half windows.

    Args:
        psf: (n, h, w) PSFs.
    """
    sides = (torch.linspace(-1, 1, n, dtype=psf.dtype) for n in psf.shape[-2:])
    y, x = torch.meshgrid(*sides, indexing="ij")
    terms = torch.stack([torch.ones_like(x), x, y]).to(psf.device)
    return torch.einsum("nyx,kyx->nk", psf, terms)


def match_moments(weights: Tensor, kernels: Tensor, psf: Tensor) -> Tensor:
    """(n, rank) weights with the least change that makes sum and centroid exact.

    A uniformly illuminated plane images as 1 - ∇·centroid + ½ ∇∇:(second moments) - …:
    its first two terms are then exact.

    Args:
        weights: (n, rank) weights of the kernels.
        kernels: (rank, h, w) low-rank kernels.
        psf: (n, h, w) PSFs whose moments are matched.
    """
    kernel_moments = psf_moments(kernels.double())
    missing = psf_moments(psf.double()) - weights.double() @ kernel_moments
    change: Tensor = missing @ torch.linalg.pinv(kernel_moments)
    return weights.double() + change


def transfer_functions(kernels: Tensor, shape: tuple[int, int]) -> Tensor:
    """(rank, Y, X // 2 + 1) transforms of kernels (rank, h, w) about their middle.

    Args:
        shape: (Y, X) size of the transform, to which kernels are padded with 0.
    """
    h, w = kernels.shape[-2:]
    padded = pad(kernels, (0, shape[1] - w, 0, shape[0] - h))
    transfer: Tensor = torch.fft.rfft2(padded.roll((-(h // 2), -(w // 2)), (-2, -1)))
    return transfer
