"""Adam along the directions in which a layer's gradients vary, for the layers that read
blur.

The log powers of a window rise and fall together: of 145 numbers one direction holds
most of the variance, and what
tells depth from texture lies across it. Adam scales every number alone, and such
directions are learned one after the
other. Scaled along the eigenvectors of the gradients' own second moments they are
learned at once (SOAP: Vyas et al.
2024, arXiv:2409.11321):

    L = <G Gᵀ>,  R = <Gᵀ G>,  U = Q_Lᵀ G Q_R,  step = Q_L (<U> / √<U²>) Q_Rᵀ    for a gradient G (outputs, inputs)

The first gradient turns at once: <U²> gathered along other axes would hold the common
direction in each of them, and
keep every step short for the hundred steps after.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor, nn

SMALLEST, WIDEST = (
    8,
    600,
)  # sides: smaller layers are left to Adam; wider sides keep their axes: moments cost too much
# of a layer's root mean square: where gradients are rounding, rounding is not blown up
LEAST = 1e-3
# steps from turn to turn, one step of orthogonal iteration each: fewer follow better,
# and cost a QR a side
TURN = 10


def layers(net: nn.Module) -> list[nn.Parameter]:
    """Weights of the dense layers that read blur and slippage: (outputs, inputs) or
    (outputs, inputs, 1, 1).

    Those of an elastic network that every member uses whole, in the order of its
    parameters.
    """
    rooms = [
        getattr(net, name) for name in ("blur", "calibration") if hasattr(net, name)
    ]
    found = [
        m
        for room in rooms
        for m in room.modules()
        if isinstance(m, nn.Linear | nn.Conv2d) and _dense(m)
    ]
    return [layer.get_parameter("weight") for layer in found]


def _dense(layer: nn.Linear | nn.Conv2d) -> bool:
    flat = layer.weight[0].numel() == layer.weight.shape[1]
    return flat and min(layer.weight.shape[:2]) >= SMALLEST


class Soap(torch.optim.Optimizer):
    """Adam along turned directions, with decoupled weight decay.

    ``weights``: (outputs, inputs) or (outputs, inputs, 1, 1). A side above WIDEST keeps
    its own axes.
    """

    def __init__(
        self,
        weights: Iterable[nn.Parameter],
        *,
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.98),
        epsilon: float = 1e-8,
        weight_decay: float = 0.0,
    ) -> None:
        """``betas``: of the mean gradient, and of all second moments, of the layer and
        along its directions.
        """
        super().__init__(
            weights,
            dict(lr=lr, betas=betas, epsilon=epsilon, weight_decay=weight_decay),
        )

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """One step of every weight that has a gradient.

        Raises:
            ValueError: a closure is given.
        """
        if closure is not None:
            raise ValueError("Soap takes no closure: call it after backward()")
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is not None:
                    self._move(weight, group)

    def _move(self, weight: Tensor, group: dict[str, Any]) -> None:
        gradient = weight.grad.flatten(1)  # type: ignore[union-attr]
        state = self.state[weight]
        if not state:
            state.update(_fresh(gradient))
        fast, slow = group["betas"]
        state["step"] += 1
        count = int(state["step"])
        _follow(state, gradient, count, slow)
        state["mean"].lerp_(gradient, 1 - fast)
        state["square"].lerp_(_turned(state, gradient) ** 2, 1 - slow)
        spread = (state["square"] / (1 - slow**count)).sqrt_()
        spread.add_(LEAST * spread.square().mean().sqrt() + group["epsilon"])
        along = _turned(state, state["mean"] / (1 - fast**count)) / spread
        weight.mul_(1 - group["lr"] * group["weight_decay"])
        weight.add_(_back(state, along).view(weight.shape), alpha=-group["lr"])


def _fresh(gradient: Tensor) -> dict[str, Tensor]:
    state = {name: torch.zeros_like(gradient) for name in ("mean", "square")}
    for side, size in _sides(gradient):
        state[f"moment_{side}"] = gradient.new_zeros(size, size)
        state[f"turn_{side}"] = torch.eye(
            size, dtype=gradient.dtype, device=gradient.device
        )
    return state | {"step": torch.zeros(())}


def _sides(gradient: Tensor) -> Iterator[tuple[str, int]]:
    """Names and sizes of the sides that are turned."""
    return (
        (name, size)
        for name, size in zip(("left", "right"), gradient.shape, strict=True)
        if size <= WIDEST
    )


def _follow(
    state: dict[str, Tensor], gradient: Tensor, count: int, slow: float
) -> None:
    """Second moments of the layer, and from time to time its directions."""
    for side, _ in _sides(gradient):
        moment = state[f"moment_{side}"]
        moment.lerp_(
            gradient @ gradient.T if side == "left" else gradient.T @ gradient, 1 - slow
        )
        if (count - 1) % TURN == 0:
            state[f"turn_{side}"] = _nearer(moment, state[f"turn_{side}"])


def _nearer(moment: Tensor, turn: Tensor) -> Tensor:
    """Orthogonal directions nearer to the eigenvectors of the moment: Q R = (M + m
    LEAST² I) Q of before.

    m: mean eigenvalue. What gradients never excite, most directions of the first steps,
    stays where it is.
    """
    own = LEAST**2 * moment.diagonal().mean()
    orthogonal: Tensor = torch.linalg.qr(moment @ turn + own * turn).Q
    return orthogonal.contiguous()


def _turned(state: dict[str, Tensor], gradient: Tensor) -> Tensor:
    """Q_Lᵀ G Q_R."""
    if "turn_left" in state:
        gradient = state["turn_left"].T @ gradient
    return gradient @ state["turn_right"] if "turn_right" in state else gradient


def _back(state: dict[str, Tensor], along: Tensor) -> Tensor:
    """Q_L U Q_Rᵀ."""
    if "turn_left" in state:
        along = state["turn_left"] @ along
    return along @ state["turn_right"].T if "turn_right" in state else along
