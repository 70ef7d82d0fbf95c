"""TOML configs read into frozen dataclasses; an unknown key is an error that names the nearest one."""

import dataclasses
import math
import reprlib
import tomllib
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

from metalens.ground.errors import ConfigError, nearest

Record = TypeVar("Record")
_LARGEST = 1 << 24  # bytes of a config
_MOST = (1 << 63) - 1  # of a whole number


def load(path: str | Path, record: type[Record]) -> Record:
    """Read a TOML file into ``record``, a frozen dataclass (nested dataclasses are tables).

    Raises:
        ConfigError: missing file, TOML syntax, unknown key, wrong type, missing key, or a value that the
            record refuses; the message gives file and key.
    """
    return from_table(read(path, record), record, where=str(path))


def read(path: str | Path, record: type[Any]) -> dict[str, Any]:
    """The tables of a TOML file that is to become ``record``.

    Raises:
        ConfigError: missing file, not text, or not TOML.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            content = file.read(_LARGEST + 1)
        if len(content) > _LARGEST:
            raise ConfigError(f"{path}: more than {_LARGEST} bytes; need a TOML config ({record.__name__})")
        text = content.decode("utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; need a TOML config ({record.__name__})") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file ({error})") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); need a TOML config") from None
    except ValueError as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{str(path)!r}: no name of a file ({error})") from None
    return _parsed(text.replace("\r\n", "\n"), str(path))


def loads(text: str, record: type[Record], *, where: str = "config") -> Record:
    """As :func:`load`, from TOML text; ``where`` names it in errors."""
    return from_table(_parsed(text, where), record, where=where)


def from_table(table: dict[str, Any], record: type[Record], *, where: str = "config") -> Record:
    """As :func:`load`, from a table that is already parsed (or merged from several)."""
    return typing.cast(Record, _build(table, record, where, ""))


def merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """``base`` with the entries of ``over`` in their place, table by table."""
    both = {
        k: merged(base[k], v) if isinstance(v, dict) and isinstance(base.get(k), dict) else v for k, v in over.items()
    }
    return base | both


def dumps(record: Any) -> str:
    """TOML text of a config record; ``loads`` gives the same record back. Fields that are None are left out."""
    lines: list[str] = []
    _dump(record, "", lines)
    return "\n".join(lines) + "\n"


def _parsed(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except ValueError as error:  # of TOML, or an integer of thousands of digits
        raise ConfigError(f"{where}: not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigError(f"{where}: not valid TOML: nested too deep") from None


def _build(table: dict[str, Any], record: Any, where: str, prefix: str) -> Any:
    fields = {f.name: f for f in dataclasses.fields(record) if f.init}
    hints = typing.get_type_hints(record)
    for key in table:
        if key not in fields:
            raise ConfigError(f"{where}: unknown key {prefix + key!r}{nearest(key, fields)}")
    values = {k: _convert(v, hints[k], where, prefix + k) for k, v in table.items()}
    for key, value in values.items():
        _check_range(fields[key], value, where, prefix + key)
    for name, f in fields.items():
        needed = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        if needed and name not in values:
            raise ConfigError(f"{where}: missing key {prefix + name!r} in {record.__name__}")
    try:
        return record(**values)
    except ConfigError:
        raise
    except (ValueError, TypeError, ArithmeticError) as error:
        raise ConfigError(f"{where}: {prefix or 'top level: '}{error}") from error


def _check_range(field: dataclasses.Field[Any], value: Any, where: str, key: str) -> None:
    """Infinity only where a field expects it; seeds as random generators take them."""
    if field.name == "seed" and isinstance(value, int) and value < 0:
        raise ConfigError(f"{where}: {key} is {value}, need 0 or more")
    if _holds_infinity(value) and field.default != math.inf and not field.metadata.get("may_be_inf"):
        raise ConfigError(f"{where}: {key} is {value}, need a finite number")


def _holds_infinity(value: Any) -> bool:
    if isinstance(value, tuple):
        return any(map(_holds_infinity, value))
    return isinstance(value, float) and math.isinf(value)


def _convert(value: Any, hint: Any, where: str, key: str) -> Any:
    if typing.get_origin(hint) is typing.Annotated:
        hint = typing.get_args(hint)[0]
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(value, options, where, key)
    if origin is typing.Literal:
        if value not in options:
            raise ConfigError(f"{where}: {key} is {_shown(value)}{nearest(_shown(value), map(str, options))}")
        return value
    if origin is tuple:
        return _convert_tuple(value, options, where, key)
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise _wrong(value, "a table", where, key)
        return _build(value, hint, where, key + ".")
    return _convert_scalar(value, hint, where, key)


def _kinds(options: tuple[Any, ...]) -> dict[str, Any]:
    """Records by their ``kind``, where all of the options tell it."""
    found: dict[str, Any] = {}
    for option in options:
        kind = dataclasses.is_dataclass(option) and typing.get_type_hints(option).get("kind")
        if not kind or typing.get_origin(kind) is not typing.Literal:
            return {}
        found |= dict.fromkeys(typing.get_args(kind), option)
    return found


def _convert_union(value: Any, options: tuple[Any, ...], where: str, key: str) -> Any:
    kinds = _kinds(options)
    if kinds and isinstance(value, dict):
        kind = value.get("kind")
        if not isinstance(kind, str) or kind not in kinds:
            raise ConfigError(f"{where}: {key}.kind is {_shown(kind)}{nearest(_shown(kind), kinds)}")
        return _convert(value, kinds[kind], where, key)
    errors = []
    records = [option for option in options if dataclasses.is_dataclass(option)]
    if isinstance(value, dict) and len(records) > 1:  # the record that knows most of the keys
        known = [len(value.keys() & {f.name for f in dataclasses.fields(option)}) for option in records]
        return _convert(value, records[known.index(max(known))], where, key)
    for option in options:
        if option is type(None):
            continue
        try:
            return _convert(value, option, where, key)
        except ConfigError as error:
            errors.append(error)
    raise errors[-1]


def _convert_tuple(value: Any, options: tuple[Any, ...], where: str, key: str) -> Any:
    if not isinstance(value, list):
        raise _wrong(value, "a list", where, key)
    if len(options) == 2 and options[1] is ...:
        options = (options[0],) * len(value)
    if len(options) != len(value):
        raise ConfigError(f"{where}: {key} has {len(value)} entries, need {len(options)}")
    pairs = zip(value, options, strict=True)
    return tuple(_convert(v, hint, where, f"{key}[{i}]") for i, (v, hint) in enumerate(pairs))


def _convert_scalar(value: Any, hint: Any, where: str, key: str) -> Any:
    if hint is Path and isinstance(value, str):
        if "\0" in value:
            raise ConfigError(f"{where}: {key} is {_shown(value)}, need the name of a file")
        return Path(value)
    if isinstance(value, int) and not -_MOST <= value <= _MOST:
        raise ConfigError(f"{where}: {key} is {_shown(value)}, need at most {_MOST:g} in magnitude")
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        if math.isnan(value):
            raise ConfigError(f"{where}: {key} is nan, need a number")
        return float(value)
    if hint in (int, str, bool) and type(value) is hint:
        return value
    raise _wrong(value, getattr(hint, "__name__", str(hint)), where, key)


def _wrong(value: Any, need: str, where: str, key: str) -> ConfigError:
    return ConfigError(f"{where}: {key} is {_shown(value)} ({type(value).__name__}), need {need}")


def _shown(value: Any) -> str:
    """A value as it may stand in a message: not long, not deep."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 100
    short.maxlevel = 3
    try:
        return short.repr(value)
    except ValueError:  # an integer of thousands of digits
        return f"a number of {value.bit_length()} bits" if isinstance(value, int) else "too long to show"


def _dump(record: Any, prefix: str, lines: list[str]) -> None:
    values = {f.name: getattr(record, f.name) for f in dataclasses.fields(record) if f.init}
    tables = {k: v for k, v in values.items() if dataclasses.is_dataclass(v)}
    lists = {k: v for k, v in values.items() if isinstance(v, tuple) and v and dataclasses.is_dataclass(v[0])}
    for key, value in values.items():
        if key not in tables and key not in lists and value is not None:
            lines.append(f"{key} = {_text(value)}")
    for key, value in tables.items():
        lines += ["", f"[{prefix}{key}]"]
        _dump(value, f"{prefix}{key}.", lines)
    for key, entries in lists.items():
        for entry in entries:
            lines += ["", f"[[{prefix}{key}]]"]
            _dump(entry, f"{prefix}{key}.", lines)


def _escaped(c: str) -> str:
    """A character inside a TOML string."""
    if c in '\\"':
        return "\\" + c
    return "\\n" if c == "\n" else c if c >= " " and c != "\x7f" else f"\\u{ord(c):04x}"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(_text(v) for v in value) + "]"
    if isinstance(value, str | Path):
        return '"' + "".join(_escaped(c) for c in str(value)) + '"'
    return repr(value)
