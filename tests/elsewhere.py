"""A device that is not the processor, played by the processor: for code that must run
on a GPU as it is.

Tensors on :data:`AWAY` hold true numbers and say that they lie on another device. What
a GPU refuses is refused:
tensors of two devices in one operation (numbers without axes aside), ``numpy()``, a
generator of another device. What
code for the processor alone would read or write is therefore found here, without a GPU.
"""

import contextlib
import importlib
from collections.abc import Iterator
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_map

AWAY = torch.device("meta")
MOVES = ("_to_copy", "copy_")  # what may take tensors of two devices


class There(torch.Tensor):
    """A tensor elsewhere; ``held``: its numbers."""

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held):
        about = {
            "dtype": held.dtype,
            "strides": held.stride(),
            "storage_offset": held.storage_offset(),
        }
        made = torch.Tensor._make_wrapper_subclass(
            cls, held.shape, device=AWAY, requires_grad=False, **about
        )
        made.held = held
        return made

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _done(func, args, kwargs or {})


@contextlib.contextmanager
def elsewhere():
    """Within it ``device=AWAY`` gives tensors with numbers; yields the names of the
    operations that ran there.

    The other device is that of one thread and has fused steps of optimisers; parameters
    that move there stay the same
    objects, as a GPU's do.
    """
    threads = torch.get_num_threads()
    swapped = torch.__future__.get_swap_module_params_on_conversion()
    optimiser = importlib.import_module("torch.optim.optimizer")
    fused = optimiser._get_fused_kernels_supported_devices
    torch.set_num_threads(1)
    torch.__future__.set_swap_module_params_on_conversion(True)
    optimiser._get_fused_kernels_supported_devices = lambda: [*fused(), AWAY.type]
    try:
        with _Given(), _Done():
            DONE.clear()
            yield DONE
    finally:
        optimiser._get_fused_kernels_supported_devices = fused
        torch.__future__.set_swap_module_params_on_conversion(swapped)
        torch.set_num_threads(threads)


DONE: set[str] = set()


class _Given(TorchFunctionMode):
    """Tensors from lists and back, which no dispatch sees."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") == AWAY:
            return func(*args, **kwargs | {"device": "cpu"}).to(AWAY)
        if isinstance(args[0] if args else None, There):
            if func is torch.Tensor.tolist:
                return args[0].cpu().detach().tolist()
            if func is torch.Tensor.new_tensor:
                return torch.tensor(*args[1:], **{"dtype": args[0].dtype} | kwargs).to(
                    AWAY
                )
        return func(*args, **kwargs)


class _Done(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _done(func, args, kwargs or {})


def _done(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [
        a for a in _leaves((*args, *kwargs.values())) if isinstance(a, torch.Tensor)
    ]
    there = [a for a in tensors if isinstance(a, There)]
    wanted = kwargs.get("device")
    if not there and wanted is None:
        return func(*args, **kwargs)
    name = func.overloadpacket.__name__
    stays = bool(there) if wanted is None else torch.device(wanted) == AWAY
    if name == "copy_":
        stays = isinstance(args[0], There)
    elif (
        there
        and name not in MOVES
        and any(a.ndim and not isinstance(a, There) for a in tensors)
    ):
        raise RuntimeError(f"{func}: tensors of two devices")
    if stays and kwargs.get("generator") is not None:
        raise RuntimeError(f"{func}: a generator of the processor")
    if wanted is not None:
        kwargs = kwargs | {"device": torch.device("cpu")}
    held = {id(a): a.held for a in there}
    out = func(
        *_mapped(held, args),
        **{key: _mapped(held, value) for key, value in kwargs.items()},
    )
    if not stays:
        return out
    DONE.add(name)
    same = {id(a.held): a for a in there}
    return tree_map(lambda a: same[id(a)] if id(a) in same else _wrapped(a), out)


def _leaves(values: Any) -> Iterator[Any]:
    """What lists and tuples of arguments hold."""
    for value in values:
        if isinstance(value, list | tuple):
            yield from _leaves(value)
        else:
            yield value


def _mapped(held: dict[int, Any], value: Any) -> Any:
    """An argument with the numbers of what lies elsewhere in its place."""
    if isinstance(value, list | tuple):
        return type(value)(_mapped(held, part) for part in value)
    return held.get(id(value), value)


def _wrapped(value: Any) -> Any:
    """Signs that torch puts off are carried out: a wrapper has no room for them."""
    return (
        There(value.resolve_conj().resolve_neg())
        if isinstance(value, torch.Tensor)
        else value
    )
