"""Compilation of the loops over pillars that arrays cannot express."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])
_NOTICE = "first run after an installation: compiling the loops over pillars, which takes some seconds and is kept"


def compile_loop(function: Function) -> Function:
    """Machine code of ``function``, kept on disk between runs; it releases the
    interpreter lock.
    """
    return cast(
        Function, numba.njit(cache=True, nogil=True, boundscheck=False)(function)
    )


@contextmanager
def announce_compilation(say: Callable[[str], None]) -> Iterator[None]:
    """Say once that loops are compiled, if any must be: what is on disk already is
    loaded without a word.

    Args:
        say: is called with the line.
    """
    from numba.core import event

    class Notice(event.Listener):
        said = False

        def on_start(self, event: Any) -> None:
            if not self.said:
                say(_NOTICE)
            self.said = True

        def on_end(self, event: Any) -> None:
            """Nothing to say."""

    with event.install_listener("numba:compile", Notice()):
        yield
