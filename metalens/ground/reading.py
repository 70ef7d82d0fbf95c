"""Loaders that fail by type: whatever a damaged or edited file does, the answer is one error that names the file."""

import dataclasses
import functools
import typing
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from metalens.ground.errors import MetalensError, StoreError
from metalens.ground.store import DAMAGE

Made = TypeVar("Made")


def reader(load: Callable[..., Made]) -> Callable[..., Made]:
    """A ``load(path, ...)`` whose every failure on a damaged or edited file is a StoreError that names the file."""

    @functools.wraps(load)
    def checked(path: str | Path, *more: Any, **about: Any) -> Made:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", np.exceptions.ComplexWarning)  # complex numbers where real ones belong
                made = load(path, *more, **about)
            _check_types(made)
        except MetalensError:
            raise
        except (*DAMAGE, IndexError, ArithmeticError, np.exceptions.ComplexWarning) as error:
            raise StoreError(f"{path}: entries of the wrong kind ({error}); edited or damaged: make it again") from None
        return made

    return checked


def _check_types(record: Any) -> None:
    """Numbers, words and arrays where the fields of a record say so.

    Raises:
        TypeError: naming the field.
    """
    if not dataclasses.is_dataclass(record):
        return
    hints = typing.get_type_hints(type(record))
    needed = {float: int | float | np.number, int: int | np.integer, str: str, bool: bool | np.bool_}
    for entry in dataclasses.fields(record):
        value, hint = getattr(record, entry.name), hints[entry.name]
        if hint in needed and (not isinstance(value, needed[hint]) or (isinstance(value, bool) and hint is not bool)):
            raise TypeError(f"{entry.name} is {type(value).__name__}, need {hint.__name__}")
        if isinstance(value, np.ndarray) and value.dtype.kind not in "biufcSU":
            raise TypeError(f"{entry.name} holds {value.dtype}, need numbers")
        _check_types(value)
