"""Axes of a stack: (n, y, x) unless its file or the capture's description says (y, x, n),
as cameras' and MATLAB's own files have it.
"""

from pathlib import Path
from typing import Any

import numpy as np

from metalens.core import reading
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

ORDERS = ("nyx", "yxn")


def stated_axes(about: dict[str, Any], where: str) -> str | None:
    """``axes`` of the capture's description, which is taken out; None where it says
    nothing.

    Args:
        about: entries of the capture's description.
        where: file or folder, for messages.

    Raises:
        CaptureError: none of ``ORDERS``.
    """
    order = about.pop("axes", None)
    if order is not None and order not in ORDERS:
        raise CaptureError(
            f'{where}: axes = {order!r}; need "nyx" (frames along the first axis of a '
            'stack) or "yxn" (along its last)'
        )
    return None if order is None else str(order)


def frames_first(
    stack: Array, path: Path, order: str | None, *, count: int | None = None
) -> tuple[Array, str]:
    """A stack as (n, y, x), and what to say where it lay otherwise.

    Args:
        stack: (n, y, x) or (y, x, n), of colour images with these behind.
        path: the file.
        order: one of ``ORDERS``, as stated; None where nobody says.
        count: of its frames, where they are listed: it tells axes of different length.

    Raises:
        CaptureError: nothing is known, and the last axis is the shortest, as of stacks
            whose frames run along it.
    """
    if stack.ndim < 3 or len(stack) == 1 or order == "nyx":
        return stack, ""
    first, second, last = stack.shape[:3]
    if order == "yxn":
        return _last_to_first(stack, path, "as stated")
    if count is not None:
        if count == last != first:
            return _last_to_first(stack, path, f"since {count} frames of it are listed")
        return stack, ""
    if last < min(first, second):
        raise CaptureError(
            f"{path}: a stack of shape {stack.shape[:3]} is {first} frames of "
            f"{second} x {last} pixels as (n, y, x), but reads like {last} frames of "
            f'{first} x {second} as (y, x, n); say which: axes = "nyx" or axes = "yxn" '
            "in capture.toml (of a single file, in the TOML of its name beside it)"
        )
    return stack, ""


def as_large(
    stack: Array, path: Path, size: tuple[int, ...], *, pitch: int = 1
) -> tuple[Array, str]:
    """Dark or flat as (n, y, x), by the size of the frames, and what to say where it
    lay otherwise.

    Args:
        stack: images as they lie in the file.
        path: the file.
        size: (y, x) of the frames as they are used, one pixel in ``pitch`` each way of
            those on disk.
        pitch: pixels from one that is used to the next.
    """

    def fits(shape: tuple[int, ...]) -> bool:
        return all(abs(a - pitch * b) < pitch for a, b in zip(shape, size, strict=True))

    if stack.ndim >= 3 and not fits(stack.shape[1:3]) and fits(stack.shape[:2]):
        return _last_to_first(stack, path, "since frames are as large")
    return stack, ""


def _last_to_first(stack: Array, path: Path, why: str) -> tuple[Array, str]:
    """A (y, x, n) stack as (n, y, x), and a note."""
    first, second, last = stack.shape[:3]
    name = reading.to_valid_utf8(path.name)
    note = (
        f"{name} taken as (y, x, n), {last} frames of {first} x {second} pixels, {why}"
    )
    return np.ascontiguousarray(np.moveaxis(stack, 2, 0)), note
