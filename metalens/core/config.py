"""TOML configs read into frozen dataclasses; an unknown key is an error that names the
nearest one.
"""

import dataclasses
import json
import math
import re
import reprlib
import sys
import tomllib
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

from metalens.core import reading
from metalens.core.errors import ConfigError, nearest_name_hint

Record = TypeVar("Record")
# text: tabs and line ends, but no other control characters
_PRINTABLE = re.compile(r"[^\x00-\x08\x0b-\x1f\x7f]*")
_BACKSLASH = (
    "a backslash in double quotes begins an escape: write a path of Windows in single "
    "quotes ('C:\\maps\\a.npy') or with /"
)
_EITHER_SIGN = ("_rad", "_deg", "_offset")  # endings of keys that may be negative
_MOST = sys.maxsize  # largest whole number of TOML


def load(path: str | Path, record: type[Record], *, empty: bool = True) -> Record:
    """Read a TOML file into ``record``, a frozen dataclass (nested dataclasses are
    tables).

    A number is from 0 to 1e9, an angle or offset from -1e9, unless the metadata of its
    field says otherwise: ``signed`` (or not), ``above`` (more than that), ``most``,
    ``may_be_inf``. A list or name has entries unless its default is empty. A seed is
    any whole number from 0. What a record itself refuses is reported with file and key.

    Args:
        path: of the file.
        record: dataclass that is filled.
        empty: whether an empty file stands for the defaults; long work refuses it.

    Raises:
        ConfigError: missing file, TOML syntax, unknown or missing key, wrong type, a
            value that the record refuses.
    """
    return from_table(read(path, record, empty=empty), record, where=str(path))


def read(path: str | Path, record: type[Any], *, empty: bool = True) -> dict[str, Any]:
    """The tables of a TOML file that is to become ``record``.

    Args:
        path: of the file.
        record: dataclass that errors name.
        empty: whether an empty file is accepted.

    Raises:
        ConfigError: missing file, not text, or not TOML; empty where that is refused.
    """
    try:
        text = reading.read_text(path)
    except UnicodeDecodeError:
        raise ConfigError(
            f"{path}: not a text file; need TOML ({record.__name__}) that names files of data"
        ) from None
    except (OSError, ValueError) as error:  # a name with a NUL is a ValueError
        reason = str(getattr(error, "strerror", error)).lower()
        raise ConfigError(
            f"{path}: {reason}; need a TOML config ({record.__name__})"
        ) from None
    if not empty and not text.strip():
        raise ConfigError(
            f"{path}: empty; need settings ({record.__name__}), or a comment line for all defaults"
        )
    return _parsed(text.replace("\r\n", "\n"), str(path))


def loads(text: str, record: type[Record], *, where: str = "config") -> Record:
    """Record from TOML text; otherwise as :func:`load`.

    Args:
        text: TOML.
        record: dataclass that is filled.
        where: names the text in errors.
    """
    return from_table(_parsed(text, where), record, where=where)


def from_table(
    table: dict[str, Any], record: type[Record], *, where: str = "config"
) -> Record:
    """Record from a table that is already parsed (or merged from several); otherwise as
    :func:`load`.

    Args:
        table: values by key.
        record: dataclass that is filled.
        where: file or place that errors name.
    """
    return typing.cast(Record, _build(table, record, where, ""))


def merge_tables(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """``base`` updated with the entries of ``over``, table by table."""
    merged = {
        key: merge_tables(base[key], value)
        if isinstance(value, dict) and isinstance(base.get(key), dict)
        else value
        for key, value in over.items()
    }
    return base | merged


def dumps(record: Any) -> str:
    """TOML text of a config record, from which ``loads`` restores it; fields that are
    None are omitted.
    """
    lines: list[str] = []
    _dump(record, "", lines)
    return "\n".join(lines) + "\n"


def _parsed(text: str, where: str) -> dict[str, Any]:
    """Tables of TOML text; a syntax error becomes a ConfigError that names ``where``."""
    try:
        return tomllib.loads(text)
    except ValueError as error:  # of TOML, or an integer of thousands of digits
        message = str(error).partition("; use sys")[0]
        raise ConfigError(
            f"{where}: not valid TOML: {message}{_path_hint(text, message)}"
        ) from None
    except RecursionError:
        raise ConfigError(f"{where}: not valid TOML: nested too deep") from None


def _path_hint(text: str, message: str) -> str:
    """Advice on Windows paths, where the line that a TOML error names has a backslash
    in double quotes; else empty.

    Args:
        text: TOML.
        message: of the error.
    """
    match = re.search(r"line (\d+)", message)
    lines = text.split("\n")
    line = lines[int(match.group(1)) - 1] if match else ""
    return f"; {_BACKSLASH}" if re.search(r'"[^"]*\\', line) else ""


def _build(table: dict[str, Any], record: Any, where: str, prefix: str) -> Any:
    """A record from a table, nested tables included.

    Args:
        table: values by key.
        record: dataclass that is filled.
        where: file or place that errors name.
        prefix: of the keys in errors, as ``cell.shape.``.

    Raises:
        ConfigError: an unknown or missing key, or a value out of range.
    """
    fields = {entry.name: entry for entry in dataclasses.fields(record) if entry.init}
    hints = typing.get_type_hints(record)
    for key in table:
        if key not in fields:
            raise ConfigError(
                f"{where}: unknown key {prefix + key!r}{nearest_name_hint(key, fields)}"
            )
    values = {}
    for key, value in table.items():
        values[key] = _convert(value, hints[key], where, prefix + key)
        _check_range(fields[key], values[key], where, prefix + key)
    for name, entry in fields.items():
        if is_required(entry) and name not in values:
            raise ConfigError(
                f"{where}: missing key {prefix + name!r} in {record.__name__}"
            )
    try:
        built = record(**values)
    except (ValueError, TypeError, ArithmeticError) as error:
        message = str(error) if len(str(error)) <= 500 else f"{str(error)[:500]} ..."
        section = f"[{prefix[:-1]}] " if prefix else ""
        raise ConfigError(f"{where}: {section}{message}") from error
    for key, value in values.items():  # signs that the record itself accepts
        _check_sign(fields[key], value, where, prefix + key)
    return built


def is_required(field: dataclasses.Field[Any]) -> bool:
    """Whether a ``field`` of a record has no default."""
    return (
        field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    )


def _check_range(
    field: dataclasses.Field[Any], value: Any, where: str, key: str, most: float = 1e9
) -> None:
    """Refuse an empty list or name, and a number that is not finite or too large;
    limits as for :func:`load`.

    Args:
        field: of the record.
        value: number, text, path or tuple.
        where: file or place that errors name.
        key: its full name in errors.
        most: largest magnitude of any number but a seed, in the unit of its key.
    """
    limits = field.metadata
    nameless = isinstance(value, Path) and not value.name
    if nameless or (value in ((), "") and field.default not in ((), "")):
        raise ConfigError(
            f"{where}: {key} is empty, need {'entries' if value == () else 'a name'}"
        )
    largest = _MOST if field.name == "seed" else limits.get("most", most)
    for number in _numbers(value):
        if number == math.inf and (
            limits.get("may_be_inf") or field.default == math.inf
        ):
            continue
        if math.isinf(number):
            raise ConfigError(f"{where}: {key} is {number}, need a finite number")
        if abs(number) > largest:
            raise ConfigError(
                f"{where}: {key} is {_shown(number)}, need at most {largest:g} in magnitude"
            )


def _check_sign(
    field: dataclasses.Field[Any], value: Any, where: str, key: str
) -> None:
    """Refuse a negative number, unless its field is signed, and one not above the
    field's lower limit.
    """
    if isinstance(value, int | float) and not isinstance(value, bool):
        limits = field.metadata
        if value < 0 and not limits.get("signed", field.name.endswith(_EITHER_SIGN)):
            raise ConfigError(f"{where}: {key} is {value}, need 0 or more")
        if "above" in limits and value <= limits["above"]:
            raise ConfigError(
                f"{where}: {key} is {value}, need more than {limits['above']}"
            )


def _numbers(value: Any) -> Iterator[int | float]:
    """Numbers in a value or in its nested tuples."""
    if isinstance(value, tuple):
        for part in value:
            yield from _numbers(part)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def _convert(value: Any, hint: Any, where: str, key: str) -> Any:
    """A TOML value as the type of its field.

    Args:
        value: from the table.
        hint: type of the field.
        where: file or place that errors name.
        key: its full name in errors.

    Raises:
        ConfigError: the value does not fit the type.
    """
    if typing.get_origin(hint) is typing.Annotated:
        hint = typing.get_args(hint)[0]
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(value, options, where, key)
    if origin is typing.Literal:
        if value not in options:
            raise ConfigError(
                f"{where}: {key} is {_shown(value)}{nearest_name_hint(_shown(value), map(str, options))}"
            )
        return value
    if origin is tuple:
        return _convert_tuple(value, options, where, key)
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise _wrong(value, "a table", where, key)
        return _build(value, hint, where, key + ".")
    return _convert_scalar(value, hint, where, key)


def _kinds(records: list[Any]) -> dict[str, Any]:
    """{kind: record} of records that each have a literal ``kind``."""
    kinds: dict[str, Any] = {}
    for record in records:
        kind = typing.get_type_hints(record).get("kind")
        kinds |= dict.fromkeys(typing.get_args(kind), record)
    return kinds


def _convert_union(value: Any, options: tuple[Any, ...], where: str, key: str) -> Any:
    """A value as one of several types.

    A table takes the record of its ``kind``, or the record that knows most of its keys.
    Any other value takes the first type that fits.

    Args:
        value: from the table.
        options: types of the union.
        where: file or place that errors name.
        key: its full name in errors.
    """
    records = [option for option in options if dataclasses.is_dataclass(option)]
    if isinstance(value, dict) and records:
        kinds = _kinds(records)
        kind = value.get("kind")
        if kinds and (not isinstance(kind, str) or kind not in kinds):
            raise ConfigError(
                f"{where}: {key}.kind is {_shown(kind)}{nearest_name_hint(_shown(kind), kinds)}"
            )
        known = [
            value.keys() & {f.name for f in dataclasses.fields(r)} for r in records
        ]
        most = records[max(range(len(records)), key=lambda i: len(known[i]))]
        return _convert(value, kinds.get(str(kind), most), where, key)
    errors = []
    for option in options:
        if option is type(None):
            continue
        try:
            return _convert(value, option, where, key)
        except ConfigError as error:
            errors.append(error)
    raise errors[-1]


def _convert_tuple(value: Any, options: tuple[Any, ...], where: str, key: str) -> Any:
    """A TOML list as a tuple, of fixed or any length, each entry converted."""
    if not isinstance(value, list):
        raise _wrong(value, "a list", where, key)
    if len(options) == 2 and options[1] is ...:
        options = (options[0],) * len(value)
    if len(options) != len(value):
        raise ConfigError(
            f"{where}: {key} has {len(value)} entries, need {len(options)}"
        )
    pairs = zip(value, options, strict=True)
    return tuple(
        _convert(v, hint, where, f"{key}[{i}]") for i, (v, hint) in enumerate(pairs)
    )


def _convert_scalar(value: Any, hint: Any, where: str, key: str) -> Any:
    """Text, path, whole number, number or boolean as the type of its field; whole
    numbers fit where a float is needed.
    """
    if (
        isinstance(value, str)
        and hint in (str, Path)
        and not _PRINTABLE.fullmatch(value)
    ):
        raise ConfigError(
            f"{where}: {key} is {_shown(value)}, need text without control characters"
        )
    if hint is Path and isinstance(value, str):
        if re.search(r"[\t\n]", value):
            raise ConfigError(f"{where}: {key} is {_shown(value)}; {_BACKSLASH}")
        return Path(value)
    if isinstance(value, int) and not -_MOST <= value <= _MOST:
        raise ConfigError(
            f"{where}: {key} is {_shown(value)}, need at most {_MOST:g} in magnitude"
        )
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        if math.isnan(value):
            raise ConfigError(f"{where}: {key} is nan, need a number")
        return float(value)
    if hint in (int, str, bool) and type(value) is hint:
        return value
    raise _wrong(value, getattr(hint, "__name__", str(hint)), where, key)


def _wrong(value: Any, need: str, where: str, key: str) -> ConfigError:
    """Refusal of a value of the wrong type."""
    return ConfigError(
        f"{where}: {key} is {_shown(value)} ({type(value).__name__}), need {need}"
    )


def _shown(value: Any) -> str:
    """A value as text for a message, shortened in length and depth."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 100
    short.maxlevel = 3
    try:
        return short.repr(value)
    except ValueError:  # an integer of thousands of digits
        return (
            f"a number of {value.bit_length()} bits"
            if isinstance(value, int)
            else "too long to show"
        )


def _dump(record: Any, prefix: str, lines: list[str]) -> None:
    """Append the TOML lines of a record: plain values, then tables, then lists of
    tables.

    Args:
        record: dataclass.
        prefix: of the names of its tables.
        lines: that are extended.
    """
    values = {
        f.name: getattr(record, f.name) for f in dataclasses.fields(record) if f.init
    }
    tables = {k: v for k, v in values.items() if dataclasses.is_dataclass(v)}
    lists = {
        k: v
        for k, v in values.items()
        if isinstance(v, tuple) and v and dataclasses.is_dataclass(v[0])
    }
    for key, value in values.items():
        if key not in tables and key not in lists and value is not None:
            lines.append(f"{key} = {_toml_value(value)}")
    for key, value in tables.items():
        lines += ["", f"[{prefix}{key}]"]
        _dump(value, f"{prefix}{key}.", lines)
    for key, entries in lists.items():
        for entry in entries:
            lines += ["", f"[[{prefix}{key}]]"]
            _dump(entry, f"{prefix}{key}.", lines)


def _toml_value(value: Any) -> str:
    """A plain value in TOML."""
    if hasattr(value, "item"):  # a scalar of NumPy
        value = value.item()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    if isinstance(value, str | Path):
        # strings of JSON are strings of TOML, but for the control character 7f
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
