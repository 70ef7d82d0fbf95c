"""Compilation of the loops over pillars that arrays cannot express."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compile_loop(function: Function) -> Function:
    """Machine code of ``function``, kept on disk between runs; it releases the
    interpreter lock.
    """
    return cast(
        Function, numba.njit(cache=True, nogil=True, boundscheck=False)(function)
    )
