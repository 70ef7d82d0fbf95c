"""Bench captures to the as-built lens, with its uncertainty.

Names load when first used: ``import characterize; characterize.fit(capture, lens)``.
"""

import importlib
from typing import Any

_VERBS = {
    "Capture": "capture",
    "load": "capture",
    "fit": "estimate",
    "AsBuilt": "asbuilt",
    "fit_pupil": "pupilfit",
    "PupilSpec": "pupil",
}


def __getattr__(name: str) -> Any:
    if name.startswith("_"):
        raise AttributeError(name)
    if name in _VERBS:
        return getattr(importlib.import_module(f"{__name__}.{_VERBS[name]}"), name)
    try:
        return importlib.import_module(f"{__name__}.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"{__name__}.{name}":
            raise
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
