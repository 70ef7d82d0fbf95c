"""From millions of pillars to a few thousand Legendre moments, with the known phase taken off in float64.

M_mn = Σ_ij P̂_m(y_i) P̂_n(x_j) T_ij exp(i(φ_ij + k·carrier_ij)), the carrier being source path plus sensor path of a
reference. Rows are handled in blocks that stay in cache; columns are folded about the lens axis, since
P̂_n(-x) = (-1)ⁿ P̂_n(x).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from metalens import legendre
from metalens.propagate_case import Case
from metalens.propagate_kernels import Carrier, carrier, carrier_turns, fill, outermost, pull
from metalens.threads import split

ROWS = 64
KEEP_BYTES = 16e6


@dataclass(frozen=True, eq=False, slots=True)
class Moments:
    """How pillars are reduced.

    carrier: the phase that is taken off; table: its polynomials, where they are small enough to be kept.
    rows: (y, m) polynomials at the pillar rows.
    folds: even and odd polynomials at the columns x >= 0, (half, n_even) and (half, n_odd).
    """

    carrier: Carrier
    table: torch.Tensor | None
    rows: torch.Tensor
    folds: tuple[torch.Tensor, torch.Tensor]

    @property
    def counts(self) -> tuple[int, int]:
        """(m, n) numbers of moments."""
        return self.rows.shape[1], self.folds[0].shape[1] + self.folds[1].shape[1]


def moments(case: Case, reference: float, counts: tuple[int, int], dtype: torch.dtype) -> Moments:
    """Polynomials for ``counts`` = (m, n) moments."""
    (y, x), (high_y, high_x) = case.pillars_um, case.half_size_um
    rows = legendre.values(counts[0], y / high_y)
    half = legendre.values(counts[1], x[case.shape[1] // 2 :] / high_x)
    folds = tuple(torch.tensor(np.ascontiguousarray(half[:, p::2]), dtype=dtype) for p in (0, 1))
    wave = carrier(case, reference, folds[0].element_size())
    size = case.shape[0] * -(-case.shape[1] // wave.width) * wave.order * 8
    table = torch.tensor(wave.table(0, case.shape[0])) if size <= KEEP_BYTES else None
    return Moments(wave, table, torch.tensor(rows, dtype=dtype), (folds[0], folds[1]))


def reduce(phase_rad: torch.Tensor, transmission: torch.Tensor, plan: Moments) -> torch.Tensor:
    """(m, n) complex moments of a lens; differentiable in phase and transmission, (y, x) real of the plan's dtype.

    Accuracy: float32 4e-7, float64 1e-15 of the root sum of squares of the pillars, incoherent.
    """
    parts = _Reduce.apply(phase_rad, transmission, plan)  # type: ignore[no-untyped-call]
    return torch.complex(parts[0], parts[1])


class _Reduce(torch.autograd.Function):
    """Moments (2, m, n); the backward pass forms the phasors again rather than keep them."""

    @staticmethod
    def forward(ctx: Any, phase: torch.Tensor, level: torch.Tensor, plan: Moments) -> torch.Tensor:
        ctx.save_for_backward(phase, level)
        ctx.plan = plan
        counts = plan.counts
        sums = torch.zeros((phase.shape[0], 2, counts[1]), dtype=plan.rows.dtype, device=phase.device)
        for rows, reach, buffer in _blocks(phase, level, plan):
            _phasors(phase[rows], level[rows], plan, rows.start, buffer)
            for parity in (0, 1):
                part = buffer[parity].flatten(0, 1) @ plan.folds[parity][:reach]
                sums[rows, :, parity::2] = part.view(buffer.shape[1], 2, -1)
        return (plan.rows.T @ sums.flatten(1)).view(counts[0], 2, counts[1]).movedim(1, 0).contiguous()

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, torch.Tensor | None, None]:
        phase, level = ctx.saved_tensors
        plan: Moments = ctx.plan
        need = ctx.needs_input_grad
        out_phase = torch.zeros_like(phase) if need[0] else None
        out_level = torch.zeros_like(level) if need[1] else None
        m, n = plan.counts
        sums = (plan.rows @ grads[0].movedim(0, 1).reshape(m, 2 * n)).view(-1, 2, n)
        folds = [sums[:, :, parity::2].contiguous() for parity in (0, 1)]
        for rows, reach, buffer in _blocks(phase, level, plan, everything=need[1]):
            for parity in (0, 1):
                part = folds[parity][rows].flatten(0, 1)
                torch.mm(part, plan.folds[parity][:reach].T, out=buffer[parity].flatten(0, 1))
            targets = tuple(None if t is None else t[rows] for t in (out_phase, out_level))
            _pull(phase[rows], level[rows], plan, rows.start, buffer, targets)
        return out_phase, out_level, None


def _blocks(phase: torch.Tensor, level: torch.Tensor, plan: Moments, everything: bool = False) -> Any:
    """(rows, reach, buffer) of every block with light: folded columns, buffer (parity, row, re/im, column)."""
    ny, nx = phase.shape
    half = (nx + 1) // 2
    store = torch.empty(2 * 2 * ROWS * half, dtype=plan.rows.dtype, device=phase.device)
    for start in range(0, ny, ROWS):
        rows = slice(start, min(start + ROWS, ny))
        reach = half if everything else _reach(level[rows], half)
        if reach:
            count = rows.stop - start
            yield rows, reach, store[: 4 * count * reach].view(2, count, 2, reach)


def _reach(level: torch.Tensor, half: int) -> int:
    """Folded columns up to the outermost open pillar of a block."""
    if level.device.type != "cpu":
        return half
    measure: Any = outermost
    return half - int(measure(level.detach().numpy(), half))


def _table(plan: Moments, start: int, stop: int) -> Any:
    """Carrier polynomials of rows start to stop."""
    return plan.carrier.table(start, stop) if plan.table is None else plan.table.numpy()[start:stop]


def _phasors(phase: torch.Tensor, level: torch.Tensor, plan: Moments, start: int, buffer: torch.Tensor) -> None:
    """Fill the buffer with the folded phasors of a block of rows."""
    if phase.device.type != "cpu":
        light = _light(phase, level, plan, start)
        _fold(light, buffer)
        return
    kernel: Any = fill
    u = plan.carrier.positions
    phases, levels, out = phase.detach().numpy(), level.detach().numpy(), buffer.numpy()

    def work(a: int, b: int) -> None:
        kernel(phases[a:b], levels[a:b], _table(plan, start + a, start + b), u, out[:, a:b])

    split(phase.shape[0], work)


def _pull(phase: torch.Tensor, level: torch.Tensor, plan: Moments, start: int, buffer: torch.Tensor, out: Any) -> None:
    """Turn gradients of the folded phasors into gradients of phase and transmission."""
    if phase.device.type != "cpu":
        turn = _light(phase, torch.ones_like(level), plan, start)
        grad = _unfold(buffer, phase.shape[1])
        if out[0] is not None:
            out[0].copy_((grad[:, 1] * turn.real - grad[:, 0] * turn.imag) * level)
        if out[1] is not None:
            out[1].copy_(grad[:, 0] * turn.real + grad[:, 1] * turn.imag)
        return
    kernel: Any = pull
    u = plan.carrier.positions
    none = np.empty((0, 0), phase.detach().numpy().dtype)
    arrays = [phase.detach().numpy(), level.detach().numpy(), *(none if t is None else t.numpy() for t in out)]
    pulled = buffer.numpy()

    def work(a: int, b: int) -> None:
        kernel(*(v[a:b] for v in arrays), _table(plan, start + a, start + b), u, pulled[:, a:b])

    split(phase.shape[0], work)


def _light(phase: torch.Tensor, level: torch.Tensor, plan: Moments, start: int) -> torch.Tensor:
    """(y, x) complex phasors of a block, for devices without compiled loops."""
    case = plan.carrier.case
    y, x = (torch.tensor(v, device=phase.device) for v in case.pillars_um)
    y = y[start : start + phase.shape[0], None]
    turns = phase.double() / (2 * torch.pi) + carrier_turns(case, plan.carrier.reference, x, y)
    angle = ((turns - turns.round()) * 2 * torch.pi).to(plan.rows.dtype)
    return torch.complex(level * torch.cos(angle), level * torch.sin(angle))


def _fold(light: torch.Tensor, buffer: torch.Tensor) -> None:
    """(y, x) complex into (parity, y, re/im, folded column); the axis column of an odd grid counts once."""
    nx = light.shape[1]
    reach = buffer.shape[-1]
    right = torch.view_as_real(light[:, nx // 2 :])[:, :reach].movedim(-1, 1)
    left = torch.view_as_real(light.flip(-1)[:, nx // 2 :])[:, :reach].movedim(-1, 1)
    buffer[0], buffer[1] = right + left, right - left
    if nx % 2:
        buffer[0, :, :, 0] = right[:, :, 0]


def _unfold(buffer: torch.Tensor, nx: int) -> torch.Tensor:
    """Adjoint of :func:`_fold`: (y, re/im, x)."""
    reach = buffer.shape[-1]
    out = buffer.new_zeros((buffer.shape[1], 2, nx))
    half = (nx + 1) // 2
    out[:, :, half - reach : half] = (buffer[0] - buffer[1]).flip(-1)
    out[:, :, nx // 2 : nx // 2 + reach] = buffer[0] + buffer[1]
    return out
