"""Diameter map to fabrication-tolerant mask: process, cells, polygons, writers, readers, checks, solids.

Names load when first used: ``import layout; layout.write_oasis(layout.plan(lens, process), path)``.
"""

import importlib
from typing import Any

# public name: (module, name there)
_FUNCTIONS = {
    "plan": ("layout.build", "plan"),
    "check": ("layout.drc", "check"),
    "compare": ("layout.verify", "compare"),
    "write_oasis": ("layout.oasis_write", "write"),
    "read_oasis": ("layout.oasis_read", "read"),
    "write_gdsii": ("layout.gdsii_write", "write"),
    "read_gdsii": ("layout.gdsii_read", "read"),
    "write_dxf": ("layout.dxf", "write"),
}


def __getattr__(name: str) -> Any:
    if name in _FUNCTIONS:
        module, function = _FUNCTIONS[name]
        return getattr(importlib.import_module(module), function)
    if name.startswith("_"):
        raise AttributeError(name)
    try:
        return importlib.import_module(f"{__name__}.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"{__name__}.{name}":
            raise
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None


def __dir__() -> list[str]:
    return sorted([*globals(), *_FUNCTIONS])
