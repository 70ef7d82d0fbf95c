"""TOML configs read into frozen dataclasses; an unknown key is an error that names the
nearest one.
"""

import dataclasses
import inspect
import math
import re
import reprlib
import textwrap
import tomllib
import types
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from metalens.core import reading
from metalens.core.errors import ConfigError, nearest_name_hint

Record = TypeVar("Record")
_LARGEST = 1 << 24  # bytes of a config
_WORDS = re.compile(
    r"[^\x00-\x08\x0b-\x1f\x7f]*"
)  # text: blanks and line ends, no other control characters
_BACKSLASH = (
    "a backslash in double quotes begins an escape: write a path of Windows in single "
    "quotes ('C:\\maps\\a.npy') or with /"
)
_KEY = re.compile(r"(?<!\S)((?:\w+,\s+)*\w+):\s")  # in the docstring of a record
_EITHER_SIGN = ("_rad", "_deg", "_offset")
_MOST, _LARGE = (
    (1 << 63) - 1,
    1e9,
)  # of a seed; of any other number, in the unit of its key


def load(path: str | Path, record: type[Record], *, empty: bool = True) -> Record:
    """Read a TOML file into ``record``, a frozen dataclass (nested dataclasses are
    tables).

    Args:
        path: file to read or write.
        empty: whether a file without a word stands for the defaults; long work refuses
            it.

    A number is from 0 to 1e9, an angle or offset from -1e9, unless the metadata of its
    field says more: ``signed`` (or
    not), ``above`` (more than that), ``most``, ``may_be_inf``; a list or name has
    entries unless its default is empty
    or ``may_be_empty``. A seed is any whole number from 0. What a record itself refuses
    comes with file and key.

    Raises:
        ConfigError: missing file, TOML syntax, unknown or missing key, wrong type, a
            value that the record refuses.
    """
    return from_table(read(path, record, empty=empty), record, where=str(path))


def read(path: str | Path, record: type[Any], *, empty: bool = True) -> dict[str, Any]:
    """The tables of a TOML file that is to become ``record``.

    Args:
        path: file to read or write.

    Raises:
        ConfigError: missing file, not text, or not TOML; empty where that is no answer.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            content = file.read(_LARGEST + 1)
        if len(content) > _LARGEST:
            raise ConfigError(
                f"{path}: more than {_LARGEST} bytes; need a TOML config ({record.__name__})"
            )
        text = reading.decode_text(content)
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such file; need a TOML config ({record.__name__})"
        ) from None
    except UnicodeDecodeError:
        raise ConfigError(
            f"{path}: not a text file; need TOML ({record.__name__}) that names files of data"
        ) from None
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror}); need a TOML config"
        ) from None
    except ValueError as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{str(path)!r}: no name of a file ({error})") from None
    if not empty and not text.strip():
        raise ConfigError(
            f"{path}: empty; need settings ({record.__name__}), or a comment line for all defaults"
        )
    return _parsed(text.replace("\r\n", "\n"), str(path))


def loads(text: str, record: type[Record], *, where: str = "config") -> Record:
    """As :func:`load`, from TOML text; ``where`` names it in errors.

    Args:
        record: dataclass that is filled.
    """
    return from_table(_parsed(text, where), record, where=where)


def from_table(
    table: dict[str, Any], record: type[Record], *, where: str = "config"
) -> Record:
    """As :func:`load`, from a table that is already parsed (or merged from several).

    Args:
        record: dataclass that is filled.
        where: file or place that errors name.
    """
    return typing.cast(Record, _build(table, record, where, ""))


def merge_tables(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """``base`` with the entries of ``over`` in their place, table by table."""
    both = {
        k: merge_tables(base[k], v)
        if isinstance(v, dict) and isinstance(base.get(k), dict)
        else v
        for k, v in over.items()
    }
    return base | both


def dumps(record: Any) -> str:
    """TOML text of a config record; ``loads`` gives the same record back. Fields that
    are None are left out.
    """
    lines: list[str] = []
    _dump(record, "", lines)
    return "\n".join(lines) + "\n"


def _parsed(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except ValueError as error:  # of TOML, or an integer of thousands of digits
        words = str(error).partition("; use sys")[0]
        raise ConfigError(
            f"{where}: not valid TOML: {words}{_path_hint(text, words)}"
        ) from None
    except RecursionError:
        raise ConfigError(f"{where}: not valid TOML: nested too deep") from None


def _path_hint(text: str, words: str) -> str:
    """The cure where the line of an error holds a backslash in double quotes."""
    place = re.search(r"line (\d+)", words)
    lines = text.split("\n")
    line = lines[int(place.group(1)) - 1] if place else ""
    return f"; {_BACKSLASH}" if re.search(r'"[^"]*\\', line) else ""


def _build(table: dict[str, Any], record: Any, where: str, prefix: str) -> Any:
    fields = {f.name: f for f in dataclasses.fields(record) if f.init}
    hints = typing.get_type_hints(record)
    for key in table:
        if key not in fields:
            elsewhere: dict[str, str] = getattr(record, "ELSEWHERE", {})
            raise ConfigError(
                f"{where}: unknown key {prefix + key!r}{nearest_name_hint(key, fields, elsewhere)}"
            )
    values = {}
    for key, value in table.items():
        with _meaning(record, key):
            values[key] = _convert(value, hints[key], where, prefix + key)
            _check_range(fields[key], values[key], where, prefix + key)
    for name, f in fields.items():
        if _required(f) and name not in values:
            with _meaning(record, name):
                raise ConfigError(
                    f"{where}: missing key {prefix + name!r} in {record.__name__}"
                )
    try:
        made = record(**values)
    except (ValueError, TypeError, ArithmeticError) as error:
        raise ConfigError(
            f"{where}: {_culprit(record, values, prefix, str(error))}"
        ) from error
    for key, value in values.items():  # what the record lets pass
        with _meaning(record, key):
            _check_sign(fields[key], value, where, prefix + key)
    return made


class _Meant(ConfigError):
    """A refusal that says what its key means."""


@contextmanager
def _meaning(record: type[Any], key: str) -> Iterator[None]:
    """Lets a refusal of a key end in what the key means."""
    try:
        yield
    except _Meant:
        raise
    except ConfigError as error:
        text = textwrap.shorten(
            describe_fields(record).get(key, ""), 160, placeholder=" ..."
        )
        raise _Meant(f"{error} ({key}: {text})" if text else str(error)) from None


def describe_fields(record: type[Any]) -> dict[str, str]:
    """{field: what the docstring of a record says of it}: ``name: text`` or ``name,
    other: text``, to an empty line.
    """
    names = {f.name for f in dataclasses.fields(record)}
    doc = inspect.getdoc(record) or ""
    if doc.startswith(
        f"{record.__name__}("
    ):  # the signature that stands for a docstring
        return {}
    places = [
        m for m in _KEY.finditer(doc) if set(re.split(r",\s+", m.group(1))) <= names
    ]
    found: dict[str, str] = {}
    for place, following in zip(places, [*places, None][1:], strict=True):
        text = doc[place.end() : following.start() if following else len(doc)].split(
            "\n\n"
        )[0]
        for name in re.split(r",\s+", place.group(1)):
            found.setdefault(name, " ".join(text.split()).rstrip(" ;."))
    return found


def _required(field: dataclasses.Field[Any]) -> bool:
    return (
        field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    )


def _culprit(record: Any, values: dict[str, Any], prefix: str, said: str) -> str:
    """What a record says of its values, after the key without which it would be
    content, unless it names the key.
    """
    required = {f.name for f in dataclasses.fields(record) if _required(f)}
    said = said if len(said) <= 500 else said[:500] + " ..."
    fitting = [
        k
        for k in values
        if k not in required
        and _content(record, {n: v for n, v in values.items() if n != k})
    ]
    if any(key in said for key in fitting):
        return f"[{prefix[:-1]}] {said}" if prefix else said
    named = [f"{prefix}{key} is {_shown(values[key])}" for key in fitting[:3]]
    return f"{' or '.join(named) or prefix[:-1] or 'top level'}: {said}"


def _content(record: Any, values: dict[str, Any]) -> bool:
    try:
        record(**values)
    except (ValueError, TypeError, ArithmeticError):
        return False
    return True


def _check_range(
    field: dataclasses.Field[Any], value: Any, where: str, key: str
) -> None:
    """Numbers finite, at most 1e9 in size; no empty list or name, but where these say
    something; see :func:`load`.
    """
    limits = field.metadata
    empty = (
        field.metadata.get("may_be_empty")
        or field.default in ("", ())
        or _made(field) == ()
    )
    if (value in ((), "") and not empty) or (
        isinstance(value, Path) and not value.name
    ):
        raise ConfigError(
            f"{where}: {key} is empty, need {'entries' if value == () else 'a name'}"
        )
    largest = _MOST if field.name == "seed" else limits.get("most", _LARGE)
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
    """A number on the side of 0 that its field says."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        limits = field.metadata
        if value < 0 and not limits.get("signed", field.name.endswith(_EITHER_SIGN)):
            raise ConfigError(f"{where}: {key} is {value}, need 0 or more")
        if "above" in limits and value <= limits["above"]:
            raise ConfigError(
                f"{where}: {key} is {value}, need more than {limits['above']}"
            )


def _made(field: dataclasses.Field[Any]) -> Any:
    return (
        None
        if field.default_factory is dataclasses.MISSING
        else field.default_factory()
    )


def _numbers(value: Any) -> Iterator[int | float]:
    """Numbers in a value or in the lists of a value."""
    if isinstance(value, tuple):
        for part in value:
            yield from _numbers(part)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def _convert(value: Any, hint: Any, where: str, key: str) -> Any:
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


def _kinds(options: tuple[Any, ...]) -> dict[str, Any]:
    """Records by their ``kind``, where all of the options tell it."""
    found: dict[str, Any] = {}
    for option in options:
        kind = dataclasses.is_dataclass(option) and typing.get_type_hints(option).get(
            "kind"
        )
        if not kind or typing.get_origin(kind) is not typing.Literal:
            return {}
        found |= dict.fromkeys(typing.get_args(kind), option)
    return found


def _convert_union(value: Any, options: tuple[Any, ...], where: str, key: str) -> Any:
    kinds = _kinds(options)
    if kinds and isinstance(value, dict):
        kind = value.get("kind")
        if not isinstance(kind, str) or kind not in kinds:
            raise ConfigError(
                f"{where}: {key}.kind is {_shown(kind)}{nearest_name_hint(_shown(kind), kinds)}"
            )
        return _convert(value, kinds[kind], where, key)
    errors = []
    records = [option for option in options if dataclasses.is_dataclass(option)]
    if (
        isinstance(value, dict) and len(records) > 1
    ):  # the record that knows most of the keys
        known = [
            len(value.keys() & {f.name for f in dataclasses.fields(option)})
            for option in records
        ]
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
        raise ConfigError(
            f"{where}: {key} has {len(value)} entries, need {len(options)}"
        )
    pairs = zip(value, options, strict=True)
    return tuple(
        _convert(v, hint, where, f"{key}[{i}]") for i, (v, hint) in enumerate(pairs)
    )


def _convert_scalar(value: Any, hint: Any, where: str, key: str) -> Any:
    if isinstance(value, str) and hint in (str, Path) and not _WORDS.fullmatch(value):
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
    return ConfigError(
        f"{where}: {key} is {_shown(value)} ({type(value).__name__}), need {need}"
    )


def _shown(value: Any) -> str:
    """A value as it may stand in a message: not long, not deep."""
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
    if hasattr(value, "item"):  # a scalar of NumPy
        value = value.item()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(_text(v) for v in value) + "]"
    if isinstance(value, str | Path):
        return '"' + "".join(_escaped(c) for c in str(value)) + '"'
    return repr(value)
