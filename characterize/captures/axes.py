"""Which axis of a stack its frames run along: the first, or the last, as cameras' and
MATLAB's own files have it.
"""

from pathlib import Path
from typing import Any

import numpy as np

from metalens.core import reading
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

ORDERS = ("nyx", "yxn")
# a frame whose rows are shorter than its columns by more, in a stack that is as long,
# reads like rows
_SHORT = 2.0


def stated_axes(about: dict[str, Any], where: str) -> str | None:
    """``axes`` of the capture's description, which is taken out; None where it says
    nothing.

    Args:
        about: entries of the capture's description.

    Raises:
        CaptureError: none of ``ORDERS``.
    """
    order = about.pop("axes", None)
    if order is not None and order not in ORDERS:
        raise CaptureError(
            f'{where}: axes = {order!r}; need "nyx" (frames along the first axis of a stack) or "yxn" (along its last)'
        )
    return None if order is None else str(order)


def frames_first(
    stack: Array,
    path: Path,
    order: str | None,
    *,
    count: int | None = None,
    pages: int = 0,
) -> tuple[Array, str]:
    """A stack as (n, y, x), and what to say where it lay otherwise; a single frame as
    it is.

    What is stated decides; else the number of frames, the first axis where both fit; a
    number that fits neither is
    left to the caller. Where nothing tells and the other way is as likely, how it was
    taken is said.

    Args:
        path: the file.
        stack: (n, y, x) or (y, x, n), of colour images with these behind.
        order: one of ``ORDERS``, or None.
        count: of its frames, where it is known.
        pages: frames that it must hold, from the first on, where no more is known.

    Raises:
        CaptureError: nothing is known, and read as (n, y, x) the frames would be narrow
            strips or the picture's columns
            the frames: the last axis is below half of both others, or below both and
                these alike.
    """
    if stack.ndim < 3 or len(stack) == 1 or order == "nyx":
        return stack, ""
    first, second, last = stack.shape[:3]
    if order == "yxn":
        return _moved(stack, path, "as stated")
    if count is not None:
        fits = count == last and count != first
        return (
            _moved(stack, path, f"since {count} frames of it are listed")
            if fits
            else (stack, "")
        )
    if pages == last and pages != first:
        return _moved(stack, path, f"since its pages 0 to {pages - 1} are listed")
    if _SHORT * last < min(first, second) or last < first == second:
        raise CaptureError(
            f"{path}: a stack of shape {stack.shape[:3]} is {first} frames of {second} x {last} pixels as (n, y, x), "
            f'but reads like {last} frames of {first} x {second} as (y, x, n); say which: axes = "nyx" or '
            'axes = "yxn" in capture.toml (of a single file, in the TOML of its name beside it)'
        )
    if last < min(first, second) or second == first:
        name, taken = (
            reading.to_valid_utf8(path.name),
            f"taken as (n, y, x), {first} frames of {second} x {last} pixels",
        )
        return (
            stack,
            f'{name} {taken}; if it is {last} frames of {first} x {second}, say axes = "yxn"',
        )
    return stack, ""


def as_large(
    stack: Array, path: Path, size: tuple[int, ...], *, pitch: int = 1
) -> tuple[Array, str]:
    """Dark or flat as (n, y, x), known by the size of the frames, and what to say where
    it lay otherwise.

    Args:
        stack: images as they lie in the file.
        path: the file.
        size: (y, x) of the frames as they are used, one pixel in ``pitch`` each way of
            those on disk.
    """

    def alike(shape: tuple[int, ...]) -> bool:
        return all(abs(a - pitch * b) < pitch for a, b in zip(shape, size, strict=True))

    if stack.ndim >= 3 and not alike(stack.shape[1:3]) and alike(stack.shape[:2]):
        return _moved(stack, path, "since frames are as large")
    return stack, ""


def _moved(stack: Array, path: Path, why: str) -> tuple[Array, str]:
    first, second, last = stack.shape[:3]
    name = reading.to_valid_utf8(path.name)
    note = (
        f"{name} taken as (y, x, n), {last} frames of {first} x {second} pixels, {why}"
    )
    return np.ascontiguousarray(np.moveaxis(stack, 2, 0)), note
