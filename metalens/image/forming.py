"""Image of a scene through a lens whose PSF varies over the field, with depth, and over
the spectrum.
"""

import functools
import math
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from metalens.core.errors import SceneError
from metalens.image.low_rank import (
    EVEN,
    KernelBasis,
    LowRankPsfs,
    PsfField,
    low_rank_psfs,
    principal_kernels,
)
from metalens.image.plan import KERNELS, Grid, ImagingPlan
from metalens.image.points import Window
from metalens.image.scene import DeviceRecord, Frames, has_no_gradient
from metalens.image.slopes import by_nodes
from metalens.image.stray import StrayLight, add_stray

FAINT = 0.01  # blurred coverage below which a far sheet fades behind the near sheet
# Kernels of coverage, of those of light and at least: it matters at the borders of
# sheets alone.
COVER_SHARE, COVER_FEWEST = 0.3, 12


@dataclass(frozen=True, eq=False, slots=True)
class Imager(DeviceRecord):
    """A lens ready to image frames of one grid.

    grid, plan: samples of the scene, and nodes of the PSFs. A uniform imager has one
        node, on the axis, and no wavelengths.
    stack: (rows, columns, depths, h, w) PSFs of the nodes, of sum 1.
    energy: (rows, columns, depths) relative illumination E of each; of a uniform imager
        the same at all depths.
    basis: kernels of the PSFs.
    light: what sources give, for every sample of the frame. cover: what coverage does,
        of PSFs of sum 1.
    parts: share of the error by cause: psfs (low rank, and interpolation between field
        points and depths), planes (uniformly illuminated), spectrum, transform,
        folded (light from beyond the windows that the transform shows in them),
        polarisation (components of the field that are left out), edge (of light that
        the rim diffracts beyond the window), pillars (taken together a few micrometres
        at a time; 0 of a smooth phase), stop (of its shadow). Of a uniform imager
        kernels (low rank) alone.
    stray: light of other diffraction orders, None where the lens has no pillars.
    asked: numbers of the nodes (row * columns + column) whose PSFs' derivatives are
        computed; None for all.
    """

    grid: Grid
    plan: ImagingPlan
    stack: Tensor
    energy: Tensor
    basis: KernelBasis
    light: LowRankPsfs
    cover: LowRankPsfs
    parts: Mapping[str, float]
    stray: StrayLight | None = field(default=None)
    asked: Set[int] | None = field(default=None)

    @property
    def error(self) -> float:
        """Relative L2 error to expect of the image of a scene of mean 1 with a 1/f
        texture of standard deviation 0.3.
        """
        return math.hypot(*self.parts.values())

    @property
    def field(self) -> PsfField:
        """The PSFs at the nodes."""
        return PsfField(self.stack, self.energy, self.plan.depths_um)

    def above(self, tolerance: float) -> str:
        """Words for an error above the tolerance, with its largest part; else empty."""
        if self.error <= tolerance:
            return ""
        cause = max(self.parts, key=lambda name: self.parts[name])
        return (
            f"the image's error {self.error:.2g} is above the {tolerance:g} asked for "
            f"({cause}: {self.parts[cause]:.2g})"
        )

    def __call__(self, frames: Frames) -> Tensor:
        """(frames, y, x) irradiance of a near sheet over all that lies behind it.

        Rays that miss the near sheet meet the far sheet, which is continued behind the
        near one (:func:`occlude`), so that equal radiance of both leaves no edge.

        Raises:
            SceneError: frames of another size than the grid's with its margin.
        """
        if not self.light.uniform and _is_near_sheet_empty(frames):
            return self.surface(frames.radiance[:, 1], frames.depth_um[:, 1])
        near = frames.coverage[:, 0]
        depth_um = torch.stack([frames.depth_um[:, 0], continue_depth(frames)], 1)
        cover = torch.stack([near, 1 - near], 1)
        light, cover, depth_um = self._continued(frames.radiance, cover, depth_um)
        if self.light.uniform:
            return self._uniform_sheets(light, cover, depth_um)
        both = self._blurred(light, depth_um, illuminated=True)
        hidden = cover[:, :1].expand_as(cover)
        hidden = self._blurred(hidden, depth_um, illuminated=False)
        # away from borders, derivatives are those of the light alone
        border = (hidden > FAINT) & (hidden < 1 - FAINT)
        hidden = torch.where(border, hidden, hidden.detach())
        # full and no coverage are so, in spite of errors of kernels and between nodes
        hidden = (1 + 4 * EVEN) * hidden - 2 * EVEN
        covered, behind = hidden.clamp(0, 1).unbind(1)
        # of two sheets at one depth, the light is the sum of both
        covered = torch.stack([covered, 1 - behind], 1)
        return self._returned(occlude(both, covered), light.sum(1))

    def _uniform_sheets(self, light: Tensor, cover: Tensor, depth_um: Tensor) -> Tensor:
        """(frames, y, x) image by uniform PSFs, which keep constant radiance constant.

        Blurred light is divided by blurred coverage. The mean radiance is subtracted
        before and added after, so that rounding grows with the contrast alone.

        Args:
            light, cover, depth_um: (frames, sheets, y, x) radiance, coverage, depth.
        """
        total, covered = (
            part.detach().sum((1, 2, 3), keepdim=True) for part in (light, cover)
        )
        mean = total / covered
        pair = torch.stack([light - mean * cover, cover], 1)
        blurred = self._returned(self.cover.blur(pair, depth_um[:, None]), light)
        image = occlude(blurred[:, 0], blurred[:, 1]) + mean[:, 0]
        return image * self.energy.mean()

    def surface(self, light: Tensor, depth_um: Tensor) -> Tensor:
        """(frames, y, x) irradiance of one opaque surface in place of two sheets.

        Args:
            light, depth_um: (frames, y, x) radiance and depth, margin included.

        Raises:
            SceneError: as above.
        """
        light, depth_um = self._continued(light, depth_um)
        return self._returned(self._blurred(light, depth_um, illuminated=True), light)

    def _continued(self, *parts: Tensor) -> list[Tensor]:
        """Frames with border samples repeated outward, so that no PSF ends at them."""
        size = tuple(n + 2 * self.grid.margin for n in self.grid.samples)
        if tuple(parts[0].shape[-2:]) != size:
            raise SceneError(
                f"frames of {tuple(parts[0].shape[-2:])} samples, need {size}: grid and margin"
            )
        spare = self.grid.spare
        if not spare:
            return list(parts)
        pad = torch.nn.functional.pad
        return [pad(part, (spare,) * 4, mode="replicate") for part in parts]

    def _blurred(
        self, content: Tensor, depth_um: Tensor, *, illuminated: bool
    ) -> Tensor:
        """Light or coverage (frames, *sheets, y, x) blurred by the PSFs.

        Where PSFs carry a gradient, the nodes' own PSFs give it.
        """
        psfs = self.light if illuminated else self.cover
        total = psfs.blur(content, depth_um)
        if self.light.uniform:
            return total
        if self.stack.requires_grad and torch.is_grad_enabled():
            total = total + by_nodes(
                self.field,
                content.detach(),
                depth_um.detach(),
                illuminated=illuminated,
                asked=self.asked,
            )
        return total

    def _returned(self, whole: Tensor, light: Tensor) -> Tensor:
        """(frames, y, x) image without margin and spare, plus stray light."""
        image = self.grid.crop(whole)
        if self.stray is None:
            return image
        return add_stray(image, light, self.stray, self.grid)

    def scaled(self, factor: float) -> "Imager":
        """This imager with ``factor`` times the light, but the same stray light."""
        light = replace(self.light, table=self.light.table * factor)
        return replace(self, energy=self.energy * factor, light=light)


def build_imager(
    grid: Grid, plan: ImagingPlan, stack: Tensor, energy: Tensor, *, tolerance: float
) -> Imager:
    """Imager of the PSFs at a plan's nodes, expanded in low-rank kernels.

    Args:
        grid: where the scene is sampled.
        plan: nodes over the field and depths.
        stack: (rows, columns, depths, h, w) PSFs of the nodes, of sum 1.
        energy: (rows, columns, depths) relative illumination of the nodes.
        tolerance: of the whole image; kernels take the share ``KERNELS`` of it.
    """
    field = PsfField(stack, energy, plan.depths_um)
    kernel_tolerance = tolerance * KERNELS
    basis = principal_kernels(field, grid.frame, tolerance=kernel_tolerance)
    return _assembled(grid, plan, field, basis, {})


def uniform_imager(
    psf: Tensor, depths_um: Tensor, grid: Grid, *, tolerance: float = 1e-3
) -> Imager:
    """Shift-invariant image formation: one PSF a depth for the whole field.

    The :class:`Imager` of one field node. It is differentiable in the PSFs by kernels
    that are mixed of them; PSFs that require a gradient get as many kernels as keep the
    image's derivative by depth within 2 %.

    Args:
        psf: (depths, h, w) light on each sample, of the size of the grid's window; they
            are divided by their sums (paper Sec. 3.1).
        depths_um: (depths,) ascending; weights are linear in 1/z between them.
        grid: where the scene is sampled.
        tolerance: relative L2 error of the image of a 1/f texture, at the worst depth.

    Raises:
        SceneError: depths that do not ascend, or PSFs of another number or size.
    """
    if psf.shape != (len(depths_um), grid.window, grid.window):
        raise SceneError(
            f"PSFs {tuple(psf.shape)} of {len(depths_um)} depths for a window of "
            f"{grid.window} samples: need one a depth, of that size"
        )
    if bool((depths_um[1:] <= depths_um[:-1]).any()):
        raise SceneError(f"depths {depths_um.tolist()} um: need ascending ones")
    unit = psf / psf.sum((-2, -1), keepdim=True)
    axis, window = torch.zeros(1), Window(grid.window, grid.step_um)
    plan = ImagingPlan(axis, axis, depths_um, None, window)  # type: ignore[arg-type]
    illumination = torch.ones_like(unit[None, None, :, 0, 0]).detach()
    field = PsfField(unit[None, None], illumination, depths_um)
    basis = principal_kernels(field, grid.frame, tolerance=tolerance)
    return _assembled(grid, plan, field, basis, {"kernels": basis.error})


def with_psfs(optics: Imager, stack: Tensor, energy: Tensor) -> Imager:
    """This imager with other PSFs, its kernels the same mixtures of them.

    Changes that vary over field and depth in a way that the first stack does not show
    need an imager of their own. The gradient does not: it is that of the image through
    the PSFs of all nodes (:func:`metalens.image.slopes.by_nodes`), whatever the kernels
    lack.

    Args:
        optics: the first imager.
        stack: (rows, columns, depths, h, w) PSFs of the same nodes, of sum 1.
        energy: (rows, columns, depths) their relative illumination.
    """
    field = PsfField(stack, energy, optics.plan.depths_um)
    imager = _assembled(optics.grid, optics.plan, field, optics.basis, optics.parts)
    return replace(imager, stray=optics.stray, asked=optics.asked)


def _assembled(
    grid: Grid,
    plan: ImagingPlan,
    field: PsfField,
    basis: KernelBasis,
    parts: Mapping[str, float],
) -> Imager:
    """Imager with kernels and weights for light and, fewer of them, for coverage.

    Args:
        parts: error by cause.
    """
    few = max(round(COVER_SHARE * len(basis.mixture)), COVER_FEWEST)
    light = low_rank_psfs(field, basis, grid.frame)
    if field.uniform:
        cover = replace(light, table=light.table / field.illumination.mean())
    else:
        cover = low_rank_psfs(field, basis, grid.frame, rank=few, illuminated=False)
    return Imager(grid, plan, field.psf, field.illumination, basis, light, cover, parts)


def occlude(light: Tensor, cover: Tensor) -> Tensor:
    """(frames, y, x) radiance of a near sheet over a far sheet that extends behind it.

    (L_near + b L_far) / (C_near + b C_far) with b = (1 - C_near) / C_far, which fades
    where the far sheet covers less than :data:`FAINT`.

    Args:
        light, cover: (frames, 2, y, x) blurred light L and coverage C, near first.
    """
    free = (1 - cover[:, 0]).clamp(0, 1)
    share = (cover[:, 1] / FAINT).clamp(0, 1)
    behind = free * share * (3 - 2 * share) / cover[:, 1].clamp_min(FAINT)
    weight = cover[:, 0] + behind * cover[:, 1]
    return (light[:, 0] + behind * light[:, 1]) / weight.clamp_min(FAINT)


def continue_depth(frames: Frames) -> Tensor:
    """(frames, y, x) depth of the far sheet, continued in 1/z where it covers nothing.

    A pyramid of means (pull-push: Gortler et al., "The lumigraph", 1996).
    """
    known = frames.coverage[:, 1:] > 0
    depth_um = frames.depth_um[:, 1]
    if bool(known.all()):
        return depth_um
    vergence = torch.where(known, frames.depth_um[:, 1:], 1.0).reciprocal()
    return torch.where(known[:, 0], depth_um, 1 / _filled(vergence, known)[:, 0])


def _filled(value: Tensor, known: Tensor) -> Tensor:
    """(n, 1, y, x) values with the unknown ones from the means of 2 x 2 samples."""
    size = value.shape[-2:]
    if max(size) == 1:
        return torch.where(known, value, 0.0)
    pool = functools.partial(
        torch.nn.functional.adaptive_avg_pool2d,
        output_size=(-(-size[0] // 2), -(-size[1] // 2)),
    )
    count = pool(known.to(value))
    mean = pool(torch.where(known, value, 0.0)) / torch.where(count > 0, count, 1.0)
    coarse = torch.nn.functional.interpolate(
        _filled(mean, count > 0), size=size, mode="bilinear"
    )
    return torch.where(known, value, coarse)


def _is_near_sheet_empty(frames: Frames) -> bool:
    """Whether the near sheet is empty.

    False where coverage or radiance carries a gradient.
    """
    cover, light = frames.coverage, frames.radiance
    if not (has_no_gradient(cover) and has_no_gradient(light)):
        return False
    return not bool(cover[:, 0].any()) and not bool(light[:, 0].any())


def image_direct(radiance: Tensor, light: Tensor) -> Tensor:
    """I(X) = Σ_x L(x) light(X - x; x), every source with a PSF of its own.

    The plain reference of :class:`Imager`, of one opaque surface.

    Args:
        radiance: (y, x). light: (y, x, h, w) PSF of the source at each sample times its
            relative illumination; h and w odd.

    Returns:
        (y - h + 1, x - w + 1): what no light from beyond the frame can reach.
    """
    high, wide, h, w = light.shape
    image = light.new_zeros(high + h - 1, wide + w - 1)
    for dy in range(h):  # every sample of the window
        for dx in range(w):
            share = radiance * light[:, :, dy, dx]
            image[dy : dy + high, dx : dx + wide] += share
    return image[h - 1 : high, w - 1 : wide]
