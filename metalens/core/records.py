"""Records (frozen dataclasses) as the arrays and attributes of an artefact file."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.store import Attribute, Provenance

Record = TypeVar("Record")


def save_record(path: str | Path, kind: str, record: Any) -> None:
    """Write a record with its provenance as an artefact file.

    Args:
        path: target, replaced atomically.
        kind: of the artefact, checked when it is read.
        record: a dataclass with a field ``provenance``.
    """
    arrays, attributes = flatten_record(record)
    store.save(path, kind, arrays, attributes=attributes, provenance=record.provenance)


def load_record(path: str | Path, kind: str, record_type: type[Record]) -> Record:
    """Read what :func:`save_record` wrote, as a ``record_type``.

    Args:
        path: of the file.
        kind: of artefact that is needed.
        record_type: the dataclass.

    Raises:
        StoreError: not such a file, or an entry is missing.
    """
    stored = store.load(path, kind)
    return build_record(
        record_type,
        stored.arrays,
        stored.attributes,
        where=str(path),
        provenance=stored.provenance,
    )


def flatten_record(
    record: Any, group: str = ""
) -> tuple[dict[str, Array], dict[str, Attribute]]:
    """(arrays, attributes) of a record; fields that are None are left out.

    Args:
        record: a dataclass of arrays, numbers, text, tuples, dictionaries of arrays or
            numbers, and other records.
        group: stands before every name.
    """
    arrays: dict[str, Array] = {}
    attributes: dict[str, Attribute] = {}
    for field in dataclasses.fields(record):
        value, name = getattr(record, field.name), group + field.name
        value = value.item() if isinstance(value, np.generic) else value
        if not field.init or isinstance(value, Provenance):
            continue
        if isinstance(value, bool | int | float | str):
            attributes[name] = value
        elif isinstance(value, tuple):
            arrays[name] = np.array(value)
        elif isinstance(value, Mapping):
            arrays |= {f"{name}/{key}": np.array(one) for key, one in value.items()}
        elif _holds_arrays(type(value)):
            inner = flatten_record(value, _group(field, group))
            arrays |= inner[0]
            attributes |= inner[1]
        elif dataclasses.is_dataclass(value):
            attributes[name] = config.dumps(value)
        elif value is not None:
            arrays[name] = value
    return arrays, attributes


def build_record(
    record_type: type[Record],
    arrays: Mapping[str, Array],
    attributes: Mapping[str, Any],
    *,
    where: str,
    group: str = "",
    **given: Any,
) -> Record:
    """Inverse of :func:`flatten_record`.

    Args:
        record_type: the dataclass; a field without an entry takes its default.
        arrays: by name.
        attributes: by name.
        where: names the file in errors.
        group: stands before every name.
        given: fields that do not come from the entries.

    Raises:
        StoreError: an entry is missing whose field has no default.
    """
    hints = typing.get_type_hints(record_type)
    for field in dataclasses.fields(record_type):  # type: ignore[arg-type]
        name, kind = group + field.name, _without_none(hints[field.name])
        if field.name in given or not field.init:
            continue
        if _holds_arrays(kind):
            inner = _group(field, group)
            if any(n.startswith(inner) for n in (*arrays, *attributes)):
                given[field.name] = build_record(
                    kind, arrays, attributes, where=where, group=inner
                )
        elif typing.get_origin(kind) is dict:
            of_arrays = typing.get_args(kind)[1] is Array
            given[field.name] = {
                n.removeprefix(f"{name}/"): array if of_arrays else array.item()
                for n, array in arrays.items()
                if n.startswith(f"{name}/")
            }
        elif name in attributes:
            value = attributes[name]
            settings = dataclasses.is_dataclass(kind)
            given[field.name] = (
                config.loads(value, kind, where=f"{where}: {name}")
                if settings
                else value
            )
        elif name in arrays or _is_required(field):
            value = arrays[name]  # where it is missing, a refusal that names it
            is_tuple = typing.get_origin(kind) is tuple
            given[field.name] = _to_tuple(value.tolist()) if is_tuple else value
    return record_type(**given)


def _group(field: dataclasses.Field[Any], group: str) -> str:
    """What stands before the names of a record's entries."""
    return group if field.metadata.get("flat") else f"{group}{field.name}/"


def _holds_arrays(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind) and kind.__eq__ is object.__eq__


def _without_none(hint: Any) -> Any:
    """The type of ``X`` or ``X | None``."""
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return hint
    return next(kind for kind in typing.get_args(hint) if kind is not type(None))


def _is_required(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is missing and field.default_factory is missing


def _to_tuple(value: Any) -> Any:
    """Nested lists as tuples, bytes as text."""
    if isinstance(value, list):
        return tuple(_to_tuple(one) for one in value)
    return value.decode() if isinstance(value, bytes) else value
