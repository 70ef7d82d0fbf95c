"""Image of a scene through a lens whose PSF varies over the field, with depth, and over
the spectrum.

    I(X) = Σ_sheets Σ_points L(x) E(x, z) P(X; x, z)

E: relative illumination: cos⁴ of the field angle (projected aperture and solid angle of
a sample; of the ray through
the middle of the stop where there is one) times the light of the PSF's window. 1 is
what an ideal lens of the same
aperture sends to a sample on the axis from radiance 1; the irradiance in watts is that
times π NA'² L with sin of the
rim's angle NA' (small angles: area / distance²).
The near sheet hides the far one as in :mod:`metalens.image.scene`; where one sheet is
seen, the sum is as above, and
frames whose far sheet covers all take that sum alone, at less than half the cost.
"""

import math
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field, replace

import scipy.fft
import torch
from torch import Tensor

from metalens.field import compiled, even, products, together
from metalens.field.patches import Patch, dense, depths_first, lagrange
from metalens.field.plan import Grid, Plan
from metalens.field.slopes import by_nodes
from metalens.field.stray import Stray, add_stray
from metalens.ground.errors import SceneError
from metalens.image import Frames

FAINT = 0.01  # blurred coverage below which a far sheet fades behind the near one
CHUNK, MOST, AT_ONCE = (
    8,
    32,
    128,
)  # frames that are imaged together: on the processor at least and at most, elsewhere
# of the sheets that are imaged together on the processor, where that is more than CHUNK
# frames
SAMPLES = 1_000_000
LIGHT = ("outside", "unknown")  # of the parts: shares of light, no errors


@dataclass(frozen=True, eq=False, slots=True)
class Imager:
    """A lens ready to image frames of one grid.

    grid, plan: where the scene is sampled, and where the PSFs are known.
    stack: (rows, columns, depths, h, w) PSFs of the nodes, of sum 1. energy: (rows,
    columns, depths) E of each.
    patches: of the frame. transfer: of each patch's kernels, (rank, Y, X // 2 + 1).
    even: (y, x) of the frame, what makes even light even through the patches
    (:func:`evened`); None: left as it is.
    parts: share of the error by cause: kernels, nodes of the field, spectrum,
    transform, folded (light from beyond the
        windows that the transform shows in them), polarisation (components of the field
        that are left out, all but a
        scalar where that is within the tolerance), edge (of light that the rim bends
        about
        the window and beyond it), pillars (taken together a few micrometres at a time;
        0 of a smooth phase), stop (of
        its shadow, where there is one).
        Beside them shares of light: ``outside``, of what goes through the lens
        (:mod:`metalens.field.through`), what
        windows leave out; and, of pillars, ``unknown``: of the spectrum, what lies
        beyond their library's wavelengths
        and is taken by those within (:func:`metalens.psf.spectrum.unknown`).
    stray: light of other diffraction orders, None where the lens tells nothing of them.
    asked: numbers of the nodes (row * columns + column) whose PSFs' derivatives are
    wanted; None for all.
    """

    grid: Grid
    plan: Plan
    stack: Tensor
    energy: Tensor
    patches: list[Patch]
    transfer: list[Tensor]
    parts: Mapping[str, float]
    even: Tensor | None = field(default=None)
    stray: Stray | None = field(default=None)
    asked: Set[int] | None = field(default=None)

    @property
    def error(self) -> float:
        """Relative L2 error to expect of the image of a 1/f texture."""
        return math.hypot(
            *(value for name, value in self.parts.items() if name not in LIGHT)
        )

    def above(self, tolerance: float) -> str:
        """Words for an error above the tolerance, with the cause that weighs most;
        empty where it is not.
        """
        if self.error <= tolerance:
            return ""
        cause, most = max(
            ((k, v) for k, v in self.parts.items() if k not in LIGHT),
            key=lambda part: part[1],
        )
        return f"the image's error {self.error:.2g} is above the {tolerance:g} asked for ({cause}: {most:.2g})"

    def __call__(self, frames: Frames) -> Tensor:
        """(frames, y, x) irradiance; see the module.

        Raises:
            SceneError: frames of another size than the grid's with its margin.
        """
        return image(frames, self)

    def surface(self, light: Tensor, depth_um: Tensor) -> Tensor:
        """(frames, y, x) irradiance of one opaque surface in place of two sheets; see
        :func:`surface`.

        Raises:
            SceneError: as above.
        """
        return surface(light, depth_um, self)

    def to(self, device: torch.device | str) -> "Imager":
        """The same on a device, for frames there; grid and plan stay where they are."""
        return replace(
            self,
            stack=self.stack.to(device),
            energy=self.energy.to(device),
            patches=[patch.to(device) for patch in self.patches],
            transfer=[part.to(device) for part in self.transfer],
            even=None if self.even is None else self.even.to(device),
            stray=None if self.stray is None else self.stray.to(device),
        )


def image(frames: Frames, optics: Imager, *, chunk: int | None = None) -> Tensor:
    """(frames, y, x) irradiance of the frames; ``chunk`` of them at a time share the
    reading of a patch's tables, by
    default as many as a processor's cache holds, or as keep a GPU busy."""

    def few(*parts: Tensor) -> tuple[Tensor, Tensor]:
        return blurred(Frames(*parts), optics), parts[0].sum(1)

    return _imaged(
        [getattr(frames, name) for name in Frames.__slots__], optics, few, chunk
    )


def surface(light: Tensor, depth_um: Tensor, optics: Imager) -> Tensor:
    """(frames, y, x) irradiance of one opaque surface, (frames, y, x) radiance and
    depth: as :func:`image` of frames
    whose far sheet is this and covers all."""

    def few(lit: Tensor, deep: Tensor) -> tuple[Tensor, Tensor]:
        return _one_sheet(lit[:, None], deep[:, None], optics), lit

    return _imaged([light, depth_um], optics, few)


def _imaged(
    given: list[Tensor],
    optics: Imager,
    work: Callable[..., tuple[Tensor, Tensor]],
    chunk: int | None = None,
) -> Tensor:
    """(frames, y, x) of what ``work`` makes of some frames at a time: the image on the
    whole frame, and all light.
    """
    grid = optics.grid
    if chunk is None:
        few = min(
            max(SAMPLES // math.prod(given[0].shape[1:]) // CHUNK * CHUNK, CHUNK), MOST
        )
        chunk = few if optics.stack.device.type == "cpu" else AT_ONCE
    size = tuple(n + 2 * grid.margin for n in grid.samples)
    if tuple(given[0].shape[-2:]) != size:
        raise SceneError(
            f"frames of {tuple(given[0].shape[-2:])} samples, need {size}: grid and margin"
        )
    out = []
    for start in range(0, len(given[0]), chunk):
        whole, light = work(
            *(_continued(part[start : start + chunk], grid.spare) for part in given)
        )
        total = returned(whole, grid)
        out.append(
            total
            if optics.stray is None
            else add_stray(total, light, optics.stray, grid)
        )
    return torch.cat(out)


def _continued(field: Tensor, spare: int) -> Tensor:
    """The border samples repeated outward."""
    if not spare:
        return field
    return torch.nn.functional.pad(
        field, (spare, spare, spare, spare), mode="replicate"
    )


def blur(frames: Frames, optics: Imager) -> Tensor:
    """(frames, light and coverage, sheets, y, x) of frames as large as the grid's,
    through every patch.
    """
    return _through(frames.radiance, frames.coverage, frames.depth_um, optics, kinds=2)


def _through(
    light: Tensor, cover: Tensor, depth_um: Tensor, optics: Imager, *, kinds: int
) -> Tensor:
    """(frames, kinds, sheets, y, x) of sheets (frames, sheets, y, x): their light; of
    two kinds, coverage too.
    """
    grid, size = optics.grid, optics.stack.shape[-1]
    reach = size // 2
    whole = grid.frame[0] + 2 * reach, grid.frame[1] + 2 * reach
    out = light.new_zeros(len(light), kinds, light.shape[1], *whole)
    place = vergence(depth_um, optics.plan.depths_um)
    given = light, cover, place.detach()
    shapes = [_size(patch, size) for patch in optics.patches]
    if all(
        compiled.plain(a)
        for a in (*given, *optics.transfer, *(p.energy for p in optics.patches))
    ):
        seen = given[0].numpy(), given[1].numpy(), given[2].numpy()
        kernels = [t.contiguous().numpy() for t in optics.transfer]
        products.through(seen, optics.patches, kernels, shapes, out.numpy())
    elif out.device.type != "cpu":
        together.through(given, optics.patches, optics.transfer, shapes, out)
    else:
        for patch, transfer, shape in zip(
            optics.patches, optics.transfer, shapes, strict=True
        ):
            _add(patch, transfer, shape, given, out)
    out = out[..., reach : reach + grid.frame[0], reach : reach + grid.frame[1]]
    if (optics.stack.requires_grad or place.requires_grad) and torch.is_grad_enabled():
        out = out + _by_nodes((light.detach(), cover.detach(), place), optics, kinds)
    return out


def _by_nodes(
    given: tuple[Tensor, Tensor, Tensor], optics: Imager, kinds: int
) -> Tensor:
    """Zeros for :func:`_through` to add, with the derivatives by the PSFs of all nodes,
    and by depths through them,
    which need no map of even light; ``given`` as there."""
    light, cover, place = given
    between = [part.to(light) for part in between_nodes(optics.grid, optics.plan)]
    first, taps = lagrange(place, optics.stack.shape[2])
    level = torch.einsum("ya,xb,abz->yxz", *between, optics.energy.detach().to(light))
    index = (
        first[..., None] + torch.arange(taps.shape[-1], device=first.device)
    ).long()
    lit = (level.expand(*place.shape, -1).gather(-1, index) * taps).sum(-1)
    sources = [light * lit, cover][:kinds]
    zeros = by_nodes(optics.stack, sources, (first, taps), between, optics.asked)
    y, x = (
        slice(n // 2, n // 2 + whole)
        for n, whole in zip(optics.stack.shape[-2:], light.shape[-2:], strict=True)
    )
    return zeros[..., y, x] if optics.even is None else zeros[..., y, x] / optics.even


def _add(
    patch: Patch,
    transfer: Tensor,
    shape: tuple[int, int],
    given: tuple[Tensor, Tensor, Tensor],
    out: Tensor,
) -> None:
    """What a patch adds to :func:`_through`, by FFT; ``given`` as :func:`_sources`
    takes it.
    """
    beyond = out.shape[-1] - given[0].shape[-1]
    rows = slice(patch.rows[0], patch.rows[1] + beyond)
    columns = slice(patch.columns[0], patch.columns[1] + beyond)
    for kind, source in enumerate(_sources(patch, given, out.shape[1])):
        mixed = _mixed(torch.fft.rfft2(source, s=shape), transfer)
        place = out[:, kind, :, rows, columns]
        place += torch.fft.irfft2(mixed, s=shape)[
            ..., : place.shape[-2], : place.shape[-1]
        ]


def _sources(
    patch: Patch, given: tuple[Tensor, Tensor, Tensor], kinds: int
) -> list[Tensor]:
    """(rank, frames, sheets, y, x) light, and with two kinds coverage, of a patch,
    weighted for its kernels.

    Args:
        given: light, coverage and :func:`vergence` of the whole frame.
    """
    rows, columns = slice(*patch.rows), slice(*patch.columns)
    light, cover, place = (a[..., rows, columns] for a in given)
    weights, level = at_depth(patch, place, patch.weights.shape[1])
    return [weights * (light * level), weights[: patch.coverage] * cover][:kinds]


def _mixed(spectrum: Tensor, transfer: Tensor) -> Tensor:
    """Sum over the kernels of spectrum times transfer, without the products in memory."""
    total = spectrum[0] * transfer[0]
    for part, kernel in zip(spectrum[1:], transfer[1:], strict=False):
        total = torch.addcmul(total, part, kernel)
    return total


def vergence(depth_um: Tensor, depths_um: Tensor) -> Tensor:
    """Depths in units of the nodes, 0 … depths - 1, at equal steps of 1/z; outside the
    nodes the outermost.
    """
    near, far = float(depths_um[0]), float(depths_um[-1])
    span = 1 / near - 1 / far
    if span <= 0:
        return torch.zeros_like(depth_um)
    return (1 / near - 1 / depth_um.clamp(near, far)) * ((len(depths_um) - 1) / span)


def at_depth(patch: Patch, position: Tensor, depths: int) -> tuple[Tensor, Tensor]:
    """(rank, frames, sheets, y, x) weights and (frames, sheets, y, x) E of sources at
    these depths.
    """
    first, taps = lagrange(position, depths)
    pixel = torch.arange(patch.energy.shape[0], device=position.device).reshape(
        position.shape[-2:]
    )
    index = pixel * depths + first
    table, level = (
        patch.weights.to(position).flatten(0, 1),
        patch.energy.to(position).flatten(),
    )
    weights: Tensor = torch.zeros((), device=position.device)
    light: Tensor = torch.zeros((), device=position.device)
    for k in range(taps.shape[-1]):
        weights = weights + taps[..., k, None] * table[index + k]
        light = light + taps[..., k] * level[index + k]
    return weights.movedim(-1, 0), light


def _over(light: Tensor, cover: Tensor) -> Tensor:
    """Near sheet over far sheet: (frames, 2, y, x) each to (frames, y, x); the plain
    sum where one sheet is seen.
    """
    free = (1 - cover[:, 0]).clamp(0, 1)
    share = (cover[:, 1] / FAINT).clamp(0, 1)
    behind = free * share * (3 - 2 * share) / cover[:, 1].clamp_min(FAINT)
    weight = cover[:, 0] + behind * cover[:, 1]
    return (light[:, 0] + behind * light[:, 1]) * (
        cover.sum(1) / weight.clamp_min(FAINT)
    )


def _size(patch: Patch, window: int) -> tuple[int, int]:
    high, wide = patch.rows[1] - patch.rows[0], patch.columns[1] - patch.columns[0]
    y, x = (scipy.fft.next_fast_len(n + window - 1) for n in (high, wide))
    return int(y), int(x)


def _transfer(kernels: Tensor, shape: tuple[int, int]) -> Tensor:
    """(rank, Y, X // 2 + 1); the image of a patch starts half a window before it."""
    transfer: Tensor = torch.fft.rfft2(kernels, s=shape)
    return transfer


def blurred(frames: Frames, optics: Imager) -> Tensor:
    """(frames, y, x) image on the whole frame, without stray light."""
    if _far_alone(frames):
        return _one_sheet(frames.radiance[:, 1:], frames.depth_um[:, 1:], optics)
    both = blur(frames, optics)
    total = _over(both[:, 0], both[:, 1])
    return total if optics.even is None else total * optics.even


def _one_sheet(light: Tensor, depth_um: Tensor, optics: Imager) -> Tensor:
    """(frames, y, x) image on the whole frame of (frames, 1, y, x) light of a sheet
    that hides nothing.
    """
    total = _through(light, light, depth_um, optics, kinds=1)[:, 0, 0]
    return total if optics.even is None else total * optics.even


def _far_alone(frames: Frames) -> bool:
    """Whether the far sheet covers everything, so that nothing is hidden; never where
    coverage has derivatives.
    """
    cover, light = frames.coverage, frames.radiance
    if not (compiled.fixed(cover) and compiled.fixed(light)):
        return False
    return (
        not bool(cover[:, 0].any())
        and not bool(light[:, 0].any())
        and bool((cover[:, 1] == 1).all())
    )


def with_psfs(optics: Imager, stack: Tensor, energy: Tensor) -> Imager:
    """The same patches with other PSFs: kernels as the first ones were mixed,
    differentiable in both arguments.

    Changes that vary over field and depth in a way that the first stack does not show
    need patches of their own
    (:func:`metalens.field.engine.patched`). The gradient does not: it is that of the
    image through the PSFs of all
    nodes (:func:`metalens.field.slopes.by_nodes`), whatever the kernels lack.
    """
    flat = stack.detach().flatten(0, 2)
    mixed = [
        torch.einsum("rn,nyx->ryx", patch.mix, flat[patch.nodes])
        for patch in optics.patches
    ]
    transfer = [
        _transfer(k, _size(p, stack.shape[-1]))
        for k, p in zip(mixed, optics.patches, strict=True)
    ]
    between = [part.to(energy) for part in between_nodes(optics.grid, optics.plan)]
    made = [
        replace(patch, energy=_illumination(patch, between, energy))
        for patch in optics.patches
    ]
    changed = replace(
        optics, stack=stack, energy=energy, patches=made, transfer=transfer
    )
    return changed if optics.even is None else evened(changed)


@torch.no_grad()
def evened(optics: Imager) -> Imager:
    """The patches with the map that gives even light of the middle depth as the nodes'
    PSFs do (:mod:`.even`); it has
    no derivatives."""
    wanted = even_light(optics)
    one = torch.ones_like(wanted)[None, None]
    depth_um = 1 / (1 / optics.plan.depths_um[[0, -1]]).mean()
    found = _one_sheet(
        one, torch.full_like(one, float(depth_um)), replace(optics, even=None)
    )[0]
    return replace(optics, even=even.ratio(wanted, found))


def even_light(optics: Imager) -> Tensor:
    """(y, x) image of even light of the middle depth on the whole frame, by the nodes'
    PSFs.
    """
    depths = optics.stack.shape[2]
    middle = torch.tensor([(depths - 1) / 2], dtype=torch.float64)
    deep = dense(middle, torch.arange(depths, dtype=torch.float64))[0].to(optics.stack)
    stack, energy = (
        torch.einsum("z,abz...->ab...", deep, part.to(deep))
        for part in (optics.stack, optics.energy)
    )
    return even.light(stack, energy, between_nodes(optics.grid, optics.plan))


def returned(whole: Tensor, grid: Grid) -> Tensor:
    """(…, y, x) samples of an image of the whole frame that are returned, without
    margin and spare.
    """
    edge = grid.margin + grid.spare
    return whole[..., edge : edge + grid.samples[0], edge : edge + grid.samples[1]]


def _illumination(patch: Patch, between: list[Tensor], energy: Tensor) -> Tensor:
    """(pixels, depths) E at every pixel of a patch."""
    ends = [
        weights[a:b]
        for (a, b), weights in zip((patch.rows, patch.columns), between, strict=True)
    ]
    return depths_first(torch.einsum("ya,xb,abz->yxz", *ends, energy).flatten(0, 1))


def between_nodes(grid: Grid, plan: Plan) -> list[Tensor]:
    """(pixel rows, node rows) and (pixel columns, node columns): interpolation from the
    nodes to every pixel.
    """
    return [
        dense(
            torch.linspace(float(nodes[0]), float(nodes[-1]), n, dtype=torch.float64),
            nodes,
        )
        for n, nodes in zip(grid.frame, (plan.y_um, plan.x_um), strict=True)
    ]
