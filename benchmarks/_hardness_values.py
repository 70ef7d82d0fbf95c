"""The matrix of bad values: every key of every settings file with every value that it
should not have.
"""

import dataclasses
import math
import tomllib
import types
import typing
from collections.abc import Iterator
from typing import Any

from benchmarks import _hardness_samples as samples
from characterize.bench import Protocol
from codesign.commands.evaluate_optics import Settings as OpticsSettings
from codesign.train.run import RunConfig, preset_table
from layout.arrange import Arrangement
from layout.process import Process
from metalens.ground import config
from metalens.ground.errors import MetalensError

BAD: dict[str, Any] = {
    "nan": math.nan, "inf": math.inf, "-inf": -math.inf, "-1": -1, "-1.5": -1.5, "0": 0, "1e20": 1e20,
    "2^60": 1 << 60, "2^100": 1 << 100, "5000 digits": int("9" * 4300) * 10**700, "word": "x", "table": {"a": {"b": 1}},
    "deep": {"a": {"a": {"a": {"a": {"a": 1}}}}}, "NUL": "a\0b", "control": "a\x1b[2Jb", "list": [], "lists": [[1]],
    "empty": "", "accents": "äß", "true": True, "long": "x" * 9999, "mixed": [1, "x", None],
}  # fmt: skip
# what a record needs before one of its keys can be tried
NEEDED: dict[str, dict[str, Any]] = {
    "Blend": {"base": "SiO2", "other": "air", "share": 0.3}, "Film": {"material": "SiO2", "thickness_um": 0.1},
    "Index": {"n": 1.5}, "Known": {"name": "bias_nm", "value": 3.0}, "Cell": {"pitch_um": 0.3},
    "PhaseMap": {"file": "map.npy", "pitch_um": 0.4}, "Layer": {"height_um": 0.7, "material": "SiO2"},
    "Schedule": {"rate": 0.01}, "Into": {"file": "chip.gds"}, "Wafer": {"pitch_um": [4100.0, 3100.0]},
    "Mark": {"x_mm": -30.0, "y_mm": 0.5},
}  # fmt: skip


@dataclasses.dataclass(frozen=True, slots=True)
class Trial:
    """A value at a key: what was said against it, '' where it was taken; typed: whether
    that was a refusal.
    """

    settings: str
    key: str
    value: str
    said: str
    typed: bool = True

    @property
    def names_it(self) -> bool:
        """Whether the refusal names the file, and the key or the table that it stands
        in.
        """
        parts = [part.partition("[")[0] for part in self.key.split(".")]
        return "FILE" in self.said and any(part in self.said for part in parts[-2:])


_ARRANGEMENT = """
lens = [{file = "lens.h5", name = "A", at = [{columns = 2, step_um = [900.0, 900.0]}]}]
cell = [{file = "pads.gds", name = "PADS", at = [{x_um = -3.0}]}]
die = {size_um = [4000.0, 3000.0]}
"""


def roots() -> dict[str, tuple[Any, dict[str, Any]]]:
    """{settings: (record, a good table)} of every settings file of every command."""
    found = {
        kind: (record, tomllib.loads(text))
        for kind, (_, text, record) in samples.TEXTS.items()
    }
    found["run"] = (RunConfig, config.merged(preset_table("smoke"), found["run"][1]))
    found["process"] = (Process, found["process"][1])
    found["protocol"] = (Protocol, {"depths_um": [18000.0, 22000.0]})
    found["optics"] = (OpticsSettings, {})
    found["arrangement"] = (Arrangement, tomllib.loads(_ARRANGEMENT))
    return found


def trials() -> Iterator[Trial]:
    """Every key with every bad value, the rest of the file good."""
    for name, (record, table) in roots().items():
        for path in _keys(record):
            for shown, value in BAD.items():
                try:
                    config.from_table(_with(table, path, value), record, where="FILE")
                    yield Trial(name, _text(path), shown, "")
                except MetalensError as refusal:
                    yield Trial(name, _text(path), shown, str(refusal))
                except Exception as error:  # noqa: BLE001 (what is counted)
                    yield Trial(name, _text(path), shown, repr(error), typed=False)


Path = tuple[
    tuple[str, Any], ...
]  # (key, record of the table that stands there or None), from the top


def _text(path: Path) -> str:
    return ".".join(key for key, _ in path)


def _keys(record: Any, above: tuple[Any, ...] = ()) -> Iterator[Path]:
    hints = typing.get_type_hints(record)
    for entry in dataclasses.fields(record):
        if not entry.init:
            continue
        yield ((entry.name, None),)
        for inner, listed in _records(hints[entry.name]):
            if inner not in above:
                step = (entry.name + "[]" * listed, inner)
                yield from ((step, *rest) for rest in _keys(inner, (*above, record)))


def _records(hint: Any) -> Iterator[tuple[Any, bool]]:
    """Records that a key may hold, and whether in a list."""
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        yield hint, False
    elif origin is typing.Annotated:
        yield from _records(options[0])
    elif origin in (typing.Union, types.UnionType):
        for option in options:
            yield from _records(option)
    elif origin is tuple and len(options) == 2 and options[1] is ...:
        yield from ((inner, True) for inner, _ in _records(options[0]))


def _with(table: dict[str, Any], path: Path, value: Any) -> dict[str, Any]:
    (key, record), rest = path[0], path[1:]
    if not rest:
        return table | {key: value}
    name = key.removesuffix("[]")
    held = table.get(name)
    held = held[0] if isinstance(held, list) and held else held
    base = held if isinstance(held, dict) else _needed(record)
    changed = _with(base, rest, value)
    return table | {name: [changed] if key.endswith("[]") else changed}


def _needed(record: Any) -> dict[str, Any]:
    hint = typing.get_type_hints(record).get("kind")
    kind = (
        {"kind": typing.get_args(hint)[0]}
        if typing.get_origin(hint) is typing.Literal
        else {}
    )
    return kind | NEEDED.get(record.__name__, {})
