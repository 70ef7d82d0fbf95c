"""Optics, pixel pitch and network optimised together for an eye in front of the lens.

Names load when first used: ``import codesign; codesign.render(states)``.
"""

import importlib
from typing import Any

_PUBLIC = {
    "render": "renderer",
    "Supernet": "supernet",
    "macs": "cost",
    "search": "evolution",
    "retrain": "retraining",
}  # name: submodule that defines it


def __getattr__(name: str) -> Any:
    if name.startswith("_"):
        raise AttributeError(name)
    if name in _PUBLIC:
        return getattr(importlib.import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    try:
        return importlib.import_module(f"{__name__}.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"{__name__}.{name}":
            raise
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
