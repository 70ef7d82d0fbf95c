"""Faces of folders: public names that load when first used.

A folder's ``__init__`` lists its public names twice: under ``TYPE_CHECKING``, where
type checkers and editors read
them, and in the table that :func:`attach_lazy_exports` takes. A test holds that the two
agree.
"""

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def attach_lazy_exports(
    package: str, names: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package whose names load when
    first used (PEP 562).

    Args:
        package: its ``__name__``.
        names: public name to the module that defines it, below the package
            (``"stack"``) or absolute where it has
            a dot, with the name there after a colon where it is another
            (``"layout.formats.oasis_write:write"``); ``""`` for
            a module of the package that is itself public.

    >>> load, listed, public = attach_lazy_exports("metalens.core", {"units": "", "Console": "console"})
    >>> listed(), load("Console").__name__
    (['Console', 'units'], 'Console')
    """
    public = sorted(names)

    def load(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if not names[name]:
            return importlib.import_module(f"{package}.{name}")
        module, _, there = names[name].partition(":")
        return getattr(
            importlib.import_module(module if "." in module else f"{package}.{module}"),
            there or name,
        )

    return load, lambda: list(public), public
