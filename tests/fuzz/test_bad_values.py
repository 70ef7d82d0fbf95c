"""Random keys of every settings file with values that they should not have: refused by
file and key, and no number out of this world is taken.
"""

import dataclasses
import importlib
import math
import types
import typing

import pytest

from docs.site.reference import SETTINGS
from metalens.core import config
from metalens.core.errors import MetalensError

# never good, whatever the key
BAD = {
    "nan": math.nan,
    "-inf": -math.inf,
    "1e20": 1e20,
    "2^100": 1 << 100,
    "table": {"a": {"b": 1}},
    "deep": {"a": {"a": {"a": {"a": 1}}}},
    "NUL": "a\0b",
    "control": "a\x1b[2Jb",
    "lists": [[1]],
    "mixed": [1, "x", None],
}
# good for some keys: only the kind of refusal is judged
DOUBTFUL = {"inf": math.inf, "-1": -1, "0": 0, "word": "x", "empty": "", "true": True}
DRAWS = 1500


def records(hint):
    """(record, whether in a list) that a key may hold."""
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        yield hint, False
    elif origin is typing.Annotated:
        yield from records(options[0])
    elif origin in (typing.Union, types.UnionType):
        for option in options:
            yield from records(option)
    elif origin is tuple and len(options) == 2 and options[1] is ...:
        yield from ((inner, True) for inner, _ in records(options[0]))


def keys(record, above=()):
    """Paths of (key, whether its table is one of a list) to every key of a record."""
    hints = typing.get_type_hints(record, include_extras=True)
    for field in dataclasses.fields(record):
        if not field.init:
            continue
        yield ((field.name, False),)
        for inner, listed in records(hints[field.name]):
            if inner not in above:
                for rest in keys(inner, (*above, record)):
                    yield ((field.name, listed), *rest)


def table(path, value):
    (name, listed), rest = path[0], path[1:]
    inner = table(rest, value) if rest else value
    return {name: [inner] if listed and rest else inner}


@pytest.mark.parametrize("page", SETTINGS)
def test_bad_values_are_refused_by_file_and_key(rng, page):
    module, name, _ = SETTINGS[page]
    record = getattr(importlib.import_module(module), name)
    every = list(keys(record))
    values = list((BAD | DOUBTFUL).items())
    for _ in range(DRAWS // len(SETTINGS)):
        path = every[rng.integers(len(every))]
        word, value = values[rng.integers(len(values))]
        try:
            config.from_table(table(path, value), record, where="FILE")
        except MetalensError as refusal:
            said = str(refusal)
            assert "FILE" in said, (path, word, said)
            assert len(said) < 1500, (path, word)
        else:
            assert word not in BAD, (path, word)
