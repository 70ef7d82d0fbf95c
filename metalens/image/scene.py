"""Image formation: a scene of depth layers through depth-dependent PSFs, with occlusion
(paper Sec. 3.1).
"""

import math
from dataclasses import dataclass, replace

import scipy.fft
import torch
from torch import Tensor
from torch.autograd import forward_ad

from metalens.core.errors import SceneError

CODES = 4096  # depths of the look-up table of kernel weights, at equal steps of 1/z
# blurred coverage below which a far sheet fades behind the near one; rounding grows by
# its inverse
FAINT = 0.01


@dataclass(frozen=True, eq=False, slots=True)
class Frames:
    """Rendered sheets, index 0 near and 1 far along the axis of sheets.

    radiance: (frames, 2, y, x), already multiplied by the coverage.
    coverage: (frames, 2, y, x) in [0, 1]; the two add up to 1 where the scene is
    opaque.
    depth_um: (frames, 2, y, x) distance from the lens plane; any value where the
    coverage is 0.
    """

    radiance: Tensor
    coverage: Tensor
    depth_um: Tensor

    def __post_init__(self) -> None:
        shape = self.radiance.shape
        if (
            len(shape) != 4
            or shape[1] != 2
            or self.coverage.shape != shape
            or self.depth_um.shape != shape
        ):
            found = [
                tuple(a.shape) for a in (self.radiance, self.coverage, self.depth_um)
            ]
            raise SceneError(
                f"radiance, coverage, depth have shapes {found}, need the same (frames, 2, y, x)"
            )

    def to(self, device: torch.device | str) -> "Frames":
        """The same on a device."""
        return Frames(*(getattr(self, name).to(device) for name in Frames.__slots__))


@dataclass(frozen=True, eq=False, slots=True)
class Layers:
    """Frames cut into occupied depth layers.

    radiance, coverage: (frames, layers, y, x); radiance multiplied by the coverage.
    depth_um: (layers,).
    near: (layers,) True where the layer belongs to the near sheet.
    """

    radiance: Tensor
    coverage: Tensor
    depth_um: Tensor
    near: Tensor


@dataclass(frozen=True, eq=False, slots=True)
class PsfBasis:
    """A PSF stack over depth (and field) as a few kernels: P(z) = sum over r of
    weights[z, r] kernels[r].

    kernels: (rank, h, w).
    weights: (field rows, field columns, depths, rank); one field point where the PSF is
    the same over the image,
        otherwise a regular grid from corner to corner of the image.
    depths_um: (depths,) ascending.
    error: relative error (L2) to expect of the image of a texture, at the worst depth.
    bound: largest sum of |error| of a PSF, for PSFs of sum 1: no image of radiance 1 is
        wrong by more.
    gradient_error: relative error (L2) to expect of the derivative of an image by what
        changes the PSFs: that of the derivative by the depth of the texture.
    """

    kernels: Tensor
    weights: Tensor
    depths_um: Tensor
    error: float
    bound: float
    gradient_error: float = math.nan


def basis(
    stack: Tensor,
    depths_um: Tensor,
    *,
    tolerance: float = 1e-3,
    gradient_tolerance: float = 0.02,
    occupied_um: tuple[float, float] | None = None,
) -> PsfBasis:
    """Fewest kernels that keep the image of a texture within ``tolerance``;
    differentiable in the stack.

    The gradient is that of the stack projected on the kept weights. Changes of the PSFs
    vary with depth in ways that the stack shows weakly: a stack that requires a
    gradient gets as many kernels more as keep the derivative of the image by depth.

    A singular value decomposition of the transfer functions, weighted by the 1/f
    amplitude of natural textures:
    what a PSF does at frequencies that scenes hardly hold costs no kernels.

    Args:
        stack: (depths, h, w), or (field rows, field columns, depths, h, w).
        depths_um: (depths,) ascending.
        tolerance: relative L2 error of the image of a texture, at the worst depth.
        gradient_tolerance: of ``gradient_error``, where the stack requires a gradient.
        occupied_um: least and largest depth that the scene holds; depths further out
            are left out.

    Raises:
        SceneError: the depths do not ascend or do not match the stack.
    """
    fields = stack if stack.ndim == 5 else stack[None, None]
    if fields.shape[2] != len(depths_um) or bool(
        (depths_um[1:] <= depths_um[:-1]).any()
    ):
        raise SceneError(
            f"{len(depths_um)} depths for a stack {tuple(stack.shape)}: need one ascending depth a PSF"
        )
    if occupied_um is not None:
        low = max(int(torch.searchsorted(depths_um, occupied_um[0], right=True)) - 1, 0)
        high = min(
            int(torch.searchsorted(depths_um, occupied_um[1])), len(depths_um) - 1
        )
        fields, depths_um = fields[:, :, low : high + 1], depths_um[low : high + 1]
    flat = fields.flatten(3).flatten(0, 2)
    features = _seen(fields.detach().double())
    left, size, _ = torch.linalg.svd(features, full_matrices=False)
    share = (left * size) ** 2
    missing = torch.sqrt(_tails(share) / share.sum(1, keepdim=True)).amax(0)
    rank = max(int((missing > tolerance).sum()), 1)
    lost = _derivative_lost(features, left, fields.shape[:3])
    if stack.requires_grad:
        rank = max(rank, int((lost > gradient_tolerance).sum()))
    weights = left[:, :rank].to(flat)
    kernels = weights.mT @ flat
    residual = flat.detach() - weights @ kernels.detach()
    error = float(missing[rank]) if rank < len(missing) else 0.0
    bound = float((residual.abs().sum(1) / flat.detach().sum(1).abs()).max())
    shape = (*fields.shape[:3], rank)
    return PsfBasis(
        kernels.reshape(rank, *fields.shape[3:]),
        weights.reshape(shape),
        depths_um,
        error,
        bound,
        float(lost[rank]) if rank < len(lost) else 0.0,
    )


def _tails(power: Tensor) -> Tensor:
    """(…, n) sum of the n-th and all later powers."""
    return power.flip(-1).cumsum(-1).flip(-1)


def _derivative_lost(
    features: Tensor, left: Tensor, shape: tuple[int, ...] | torch.Size
) -> Tensor:
    """(components,) relative L2 error of the derivative by depth through so many.

    Of differences of neighbouring depths, projected on the left singular vectors.

    Args:
        features: (PSFs, frequencies). shape: (rows, columns, depths) of the PSFs.
    """
    if shape[2] < 2:
        return torch.zeros(left.shape[1], dtype=left.dtype, device=left.device)
    (change,) = torch.gradient(features.reshape(*shape, -1), dim=2)
    power = (left.mT @ change.flatten(0, 2)).square().sum(1)
    left_out = change.square().sum() - power.sum()  # beyond all components
    return torch.sqrt(
        (_tails(power) + left_out.clamp_min(0))
        / change.square().sum().clamp_min(1e-300)
    )


def _seen(fields: Tensor) -> Tensor:
    """(PSFs, frequencies) transfer functions as a 1/f texture shows them, real and
    imaginary parts side by side.
    """
    h, w = fields.shape[-2:]
    transfer = torch.fft.rfft2(fields, s=(2 * h, 2 * w))
    fy, fx = (
        torch.fft.fftfreq(2 * h, dtype=torch.float64),
        torch.fft.rfftfreq(2 * w, dtype=torch.float64),
    )
    amplitude = 1 / torch.sqrt(fy[:, None] ** 2 + fx**2 + (1 / (8 * max(h, w))) ** 2)
    amplitude = amplitude * torch.where((fx == 0) | (fx == 0.5), 1.0, 2**0.5)
    return torch.view_as_real(transfer * amplitude).flatten(3).flatten(0, 2)


def weight_maps(psf: PsfBasis, depth_um: Tensor) -> Tensor:
    """(rank, ..., y, x) weights of the kernels for sources at these depths: linear in
    1/z between the nodes.

    Depths outside the nodes take the outermost one.

    Args:
        psf: (..., h, w) PSFs.
        depth_um: source depth from the lens, um.
    """
    code = _codes(psf.depths_um, depth_um)
    table = _table(psf)
    if table.shape[:2] == (1, 1):
        return table[0, 0].index_select(1, code.flatten()).reshape(-1, *code.shape)
    sides = zip(depth_um.shape[-2:], table.shape[:2], strict=True)
    (rows, y), (columns, x) = (_span(n, f, code.device) for n, f in sides)
    total = table.new_zeros(())
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        r = (rows + down).clamp(max=table.shape[0] - 1)[:, None].expand(code.shape)
        c = (columns + right).clamp(max=table.shape[1] - 1).expand(code.shape)
        share = (y if down else 1 - y)[:, None] * (x if right else 1 - x)
        total = total + torch.stack(
            [table[r, c, k, code] for k in range(table.shape[2])]
        ) * share.to(table)
    return total


def _codes(depths_um: Tensor, depth_um: Tensor) -> Tensor:
    near, far = 1 / float(depths_um[0]), 1 / float(depths_um[-1])
    unit = (near - 1 / depth_um.clamp(float(depths_um[0]), float(depths_um[-1]))) / max(
        near - far, 1e-30
    )
    return (unit * (CODES - 1) + 0.5).long()


def _table(psf: PsfBasis) -> Tensor:
    """(field rows, field columns, rank, codes) weights at depths at equal steps of 1/z."""
    if len(psf.depths_um) == 1:
        return psf.weights.mT.expand(-1, -1, -1, CODES)
    vergence = 1 / psf.depths_um.double()
    wanted = torch.linspace(
        float(vergence[0]), float(vergence[-1]), CODES, dtype=torch.float64
    )
    upper = torch.searchsorted(-vergence, -wanted).clamp(1, len(vergence) - 1)
    part = (
        ((wanted - vergence[upper - 1]) / (vergence[upper] - vergence[upper - 1]))
        .clamp(0, 1)
        .to(psf.weights)
    )
    upper = upper.to(psf.weights.device)
    return torch.lerp(
        psf.weights[:, :, upper - 1], psf.weights[:, :, upper], part[:, None]
    ).mT


def _span(pixels: int, points: int, device: torch.device) -> tuple[Tensor, Tensor]:
    position = torch.linspace(0, points - 1, pixels, dtype=torch.float64, device=device)
    first = position.floor().long()
    return first, position - first


@dataclass(frozen=True, eq=False, slots=True)
class UniformImager:
    """Transfer functions of a basis, ready for frames of one size.

    psf: the basis. transfer: (rank, Y, X // 2 + 1). shape: (Y, X) of the transforms.
    table: (field rows, field columns, rank, CODES) weights of the kernels at depths at
    equal steps of 1/z.
    """

    psf: PsfBasis
    transfer: Tensor
    shape: tuple[int, int]
    table: Tensor

    def to(self, device: torch.device | str) -> "UniformImager":
        """The same on a device, for frames there; differentiable."""
        psf = replace(
            self.psf,
            kernels=self.psf.kernels.to(device),
            weights=self.psf.weights.to(device),
        )
        return replace(
            self,
            psf=psf,
            transfer=self.transfer.to(device),
            table=self.table.to(device),
        )


def uniform_imager(
    psf: PsfBasis, frame: tuple[int, int], *, margin: int = 0
) -> UniformImager:
    """Prepare a basis for frames of ``frame`` = (y, x) pixels that were rendered with
    ``margin`` pixels to spare.

    Args:
        psf: (..., h, w) PSFs.
    """
    reach = max(psf.kernels.shape[-2:]) // 2
    spare = 2 * max(reach - margin, 0)
    shape = tuple(scipy.fft.next_fast_len(n + spare, real=True) for n in frame)
    return UniformImager(
        psf,
        _transfer(psf.kernels, (shape[0], shape[1])),
        (shape[0], shape[1]),
        _table(psf),
    )


def image(
    frames: Frames, optics: UniformImager, *, margin: int = 0, chunk: int = 2
) -> Tensor:
    """(frames, y - 2 margin, x - 2 margin) irradiance on the sensor grid, upright, at
    unit transmission.

    Args:
        optics: lens, light and distances at the nodes.
        margin: pixels around the frame that are blurred in but not returned.
        chunk: frames at a time; a few stay in the processor's cache.
    """
    out = []
    for start in range(0, len(frames.radiance), chunk):
        part = slice(start, start + chunk)
        few = Frames(*(getattr(frames, name)[part] for name in Frames.__slots__))
        mean = _mean(few)
        source = _sources(
            replace(few, radiance=few.radiance - mean * few.coverage), optics
        )
        blurred = torch.fft.irfft2(
            _mixed(torch.fft.rfft2(source), optics), s=optics.shape
        )
        size = frames.radiance.shape[-2:]
        blurred = blurred[..., margin : size[0] - margin, margin : size[1] - margin]
        out.append(_over(blurred[:, 0], blurred[:, 1], mean[:, 0]))
    return torch.cat(out)


def _mean(frames: Frames) -> Tensor:
    """(frames, 1, 1, 1) mean radiance: taken off before the transforms, whose rounding
    then grows with the contrast.
    """
    light, cover = (
        part.detach().sum((1, 2, 3), keepdim=True)
        for part in (frames.radiance, frames.coverage)
    )
    return light / cover.clamp_min(1e-30)


def layer_spectra(frames: Frames, optics: UniformImager) -> Tensor:
    """(rank, frames, light and coverage, sheets, Y, X // 2 + 1) spectra of the frames,
    weighted for every kernel.

    They do not change with the kernels: for many images of the same frames, as in a
    design, see :func:`with_kernels`.

    Args:
        optics: lens, light and distances at the nodes.
    """
    spectrum: Tensor = torch.fft.rfft2(_sources(frames, optics))
    return spectrum


def _mixed(spectrum: Tensor, optics: UniformImager) -> Tensor:
    """Sum over the kernels of spectrum times transfer, without the products in memory."""
    total = spectrum[0] * optics.transfer[0]
    for part, transfer in zip(spectrum[1:], optics.transfer[1:], strict=True):
        total = torch.addcmul(total, part, transfer)
    return total


def _sources(frames: Frames, optics: UniformImager) -> Tensor:
    """(rank, frames, 2 kinds, 2 sheets, y, x) light and coverage weighted for every
    kernel, ready to transform.
    """
    psf, given = optics.psf, (frames.radiance, frames.coverage, frames.depth_um)
    single = psf.weights.shape[:2] == (1, 1)
    if single and all(is_compilable(a) for a in (*given, psf.weights)):
        from metalens.image.sources import weigh_sources

        ends = float(psf.depths_um[0]), float(psf.depths_um[-1])
        light, cover, depth, table = (
            a.numpy() for a in (*given, optics.table[0, 0].contiguous())
        )
        return torch.from_numpy(
            weigh_sources(light, cover, depth, table, ends_um=ends, shape=optics.shape)
        )
    pair = torch.stack([frames.radiance, frames.coverage], 1)
    if single:  # weights of the depth alone: pad once, not once a kernel
        return weight_maps(psf, pad_borders(frames.depth_um, optics.shape))[
            :, :, None
        ] * pad_borders(pair, optics.shape)
    return pad_borders(
        weight_maps(psf, frames.depth_um)[:, :, None] * pair, optics.shape
    )


def is_compilable(a: Tensor) -> bool:
    """Whether compiled code may read the values: single precision, in main memory,
    without derivatives.

    Args:
        a: a tensor.
    """
    return a.dtype in (torch.float32, torch.complex64) and is_plain_value(a)


def is_plain_value(a: Tensor) -> bool:
    """Whether it lies in main memory and carries no derivatives, backward or forward.

    Args:
        a: a tensor.
    """
    return a.device.type == "cpu" and has_no_gradient(a)


def has_no_gradient(a: Tensor) -> bool:
    """Whether it carries no derivatives, backward or forward.

    Args:
        a: a tensor.
    """
    return not a.requires_grad and forward_ad.unpack_dual(a).tangent is None  # type: ignore[no-untyped-call]


def with_kernels(optics: UniformImager, kernels: Tensor) -> UniformImager:
    """The same imager with other kernels (rank, h, w), differentiable in them.

    Args:
        optics: lens, light and distances at the nodes.
    """
    transfer = _transfer(kernels, optics.shape)
    return replace(optics, psf=replace(optics.psf, kernels=kernels), transfer=transfer)


def image_spectra(
    source: Tensor, optics: UniformImager, size: tuple[int, int]
) -> Tensor:
    """(frames, y, x) the image that :func:`image` gives, from :func:`layer_spectra` of frames
    of ``size`` = (y, x) pixels.

    Args:
        source: spectrum of the source.
        optics: lens, light and distances at the nodes.
    """
    blurred = torch.fft.irfft2(_mixed(source, optics), s=optics.shape)[
        ..., : size[0], : size[1]
    ]
    return _over(blurred[:, 0], blurred[:, 1])


def cut_layers(frames: Frames, depths_um: Tensor) -> Layers:
    """Cut frames into layers at these depths (ascending), leaving out the empty ones.

    A source between two layers is shared by both, linearly in 1/z.

    Args:
        depths_um: source depths from the lens, um.
    """
    vergence = 1 / depths_um.to(frames.depth_um)
    position = 1 / frames.depth_um.clamp(float(depths_um[0]), float(depths_um[-1]))
    parts, cover, where, near = [], [], [], []
    for sheet in (0, 1):
        for k, node in enumerate(vergence):
            below = vergence[max(k - 1, 0)] - node
            above = node - vergence[min(k + 1, len(vergence) - 1)]
            offset = position[:, sheet] - node
            share = 1 - torch.where(
                offset > 0,
                offset / below.clamp_min(1e-12),
                -offset / above.clamp_min(1e-12),
            )
            share = share.clamp(0, 1)
            if bool((share * frames.coverage[:, sheet] > 0).any()):
                parts.append(share * frames.radiance[:, sheet])
                cover.append(share * frames.coverage[:, sheet])
                where.append(depths_um[k])
                near.append(sheet == 0)
    return Layers(
        torch.stack(parts, 1),
        torch.stack(cover, 1),
        torch.stack(where),
        torch.tensor(near),
    )


def _over(light: Tensor, cover: Tensor, mean: Tensor | float = 0.0) -> Tensor:
    """Near sheet over far sheet, (frames, 2, y, x) blurred light and coverage ->
    (frames, y, x).

    ``mean``: (frames, 1, 1) radiance that was taken off the light.
    """
    free = (1 - cover[:, 0]).clamp(0, 1)
    share = (cover[:, 1] / FAINT).clamp(
        0, 1
    )  # fades smoothly in below FAINT, exact above
    behind = free * share * (3 - 2 * share) / cover[:, 1].clamp_min(FAINT)
    weight = cover[:, 0] + behind * cover[:, 1]
    over: Tensor = (
        light[:, 0] + behind * light[:, 1] + mean * weight
    ) / weight.clamp_min(FAINT)
    return over


def _transfer(kernels: Tensor, shape: tuple[int, int]) -> Tensor:
    h, w = kernels.shape[-2:]
    padded = torch.nn.functional.pad(kernels, (0, shape[1] - w, 0, shape[0] - h))
    transfer: Tensor = torch.fft.rfft2(
        torch.roll(padded, (-(h // 2), -(w // 2)), (-2, -1))
    )
    return transfer


def pad_borders(sources: Tensor, shape: tuple[int, int]) -> Tensor:
    """Continue the border pixels into the spare columns and rows: half of them belong
    to the far border.

    Args:
        shape: (y, x) samples.
    """
    for axis in (-1, -2):
        spare = shape[axis] - sources.shape[axis]
        if spare > 0:
            after = (spare + 1) // 2
            last = sources.narrow(axis, sources.shape[axis] - 1, 1)
            first = sources.narrow(axis, 0, 1)
            repeat = [1] * sources.ndim
            repeat[axis] = after
            tail = last.repeat(repeat)
            repeat[axis] = spare - after
            sources = torch.cat([sources, tail, first.repeat(repeat)], axis)
    return sources
