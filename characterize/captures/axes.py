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


def frames_first(stack: Array, path: Path, order: str | None) -> tuple[Array, str]:
    """A stack as (n, y, x), and what to say where it lay otherwise.

    Args:
        stack: (n, y, x) or (y, x, n), of colour images with these behind.
        path: the file.
        order: one of ``ORDERS``, as stated; None where nobody says.

    Raises:
        CaptureError: nothing is stated, and the last axis is the shortest, as of stacks
            whose frames run along it.
    """
    if stack.ndim < 3 or len(stack) == 1 or order == "nyx":
        return stack, ""
    first, second, last = stack.shape[:3]
    if order == "yxn":
        name = reading.to_valid_utf8(path.name)
        note = (
            f"{name} taken as (y, x, n), {last} frames of {first} x {second} pixels, "
            "as stated"
        )
        return np.ascontiguousarray(np.moveaxis(stack, 2, 0)), note
    if last < min(first, second):
        raise CaptureError(
            f"{path}: a stack of shape {stack.shape[:3]} is {first} frames of "
            f"{second} x {last} pixels as (n, y, x), but reads like {last} frames of "
            f'{first} x {second} as (y, x, n); say which: axes = "nyx" or axes = "yxn" '
            "in capture.toml (of a single file, in the TOML of its name beside it)"
        )
    return stack, ""
