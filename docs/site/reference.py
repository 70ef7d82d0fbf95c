"""Reference pages of commands, settings, presets, materials and parameters of the fit.

``python docs/site/reference.py`` writes them to docs/reference from the docstrings of
the records; a test compares the committed pages with the code. As an mkdocs hook it
brings the pages of the root into the site.
"""

import dataclasses
import importlib
import inspect
import re
import sys
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from metalens.cli import VERBS

sys.path.insert(0, str(Path(__file__).parent))
record_fields: Any = importlib.import_module("record_fields")

# settings file: (module, record, command that reads it)
SETTINGS = {
    "CELL.toml": ("metalens.commands.library", "CellFile", "library"),
    "STUDY.toml": ("metalens.library.study", "CellStudy", "study"),
    "DESIGN.toml": ("metalens.commands.design", "DesignSettings", "design"),
    "PSF.toml": ("metalens.commands.psf", "PsfSettings", "psf"),
    "ARRANGEMENT.toml": ("layout.arrange.record", "DieFloorplan", "layout"),
    "PROCESS.toml": ("layout.process.process", "Process", "layout"),
    "TRUTH.toml": ("characterize.bench.bench", "HiddenLens", "capture --truth"),
    "PROTOCOL.toml": (
        "characterize.bench.protocol",
        "BenchProtocol",
        "capture --protocol",
    ),
    "METROLOGY.toml": (
        "characterize.commands.fit",
        "MetrologySettings",
        "fit --metrology",
    ),
    "PUPIL.toml": ("characterize.pupil.model", "PupilSpec", "fit --pupil"),
    "SCENE.toml": ("codesign.commands.scene", "SceneSettings", "scene"),
    "RUN.toml": ("codesign.train.run", "RunConfig", "codesign"),
    "OPTICS.toml": (
        "codesign.commands.evaluate_optics",
        "OpticsSettings",
        "evaluate optics --config",
    ),
    "CHAIN.toml": ("metalens.commands.chain", "ChainFiles", "demo --config"),
}


def _word(kind: Any) -> str:
    origin = typing.get_origin(kind)
    if origin is typing.Annotated:
        return _word(typing.get_args(kind)[0])
    if origin is typing.Literal:
        return " \\| ".join(f"`{value}`" for value in typing.get_args(kind))
    if origin in (typing.Union, types.UnionType):
        return " or ".join(
            _word(one)
            for one in typing.get_args(kind)
            if one is not type(None) and typing.get_origin(one) is not np.ndarray
        )
    if origin is tuple:
        inside = [a for a in typing.get_args(kind) if a is not Ellipsis]
        return (
            f"list of {_word(inside[0])}"
            if Ellipsis in typing.get_args(kind)
            else f"{len(inside)} values"
        )
    if origin is dict:
        return "table"
    names = {
        float: "number",
        int: "integer",
        str: "text",
        bool: "true or false",
        Path: "file",
    }
    return names.get(kind, getattr(kind, "__name__", str(kind)))


def _marks(kind: Any) -> list[Any]:
    """What is written beside a type: of tyro an alias, a place among the words, or that
    it is hidden.
    """
    return (
        list(typing.get_args(kind)[1:])
        if typing.get_origin(kind) is typing.Annotated
        else []
    )


def _flag(name: str, kind: Any) -> str | None:
    """The option as it is typed, with its other names; a positional word in capitals;
    None for what is hidden.
    """
    marks = _marks(kind)
    if any(mark == tyro.conf.Suppress[int].__metadata__[0] for mark in marks):
        return None
    if any(mark == tyro.conf.Positional[int].__metadata__[0] for mark in marks):
        return f"`{name.upper()}`"
    others = [alias for mark in marks for alias in getattr(mark, "aliases", None) or ()]
    return ", ".join(f"`{flag}`" for flag in (f"--{name.replace('_', '-')}", *others))


def _default(field: "dataclasses.Field[Any]") -> str:
    if field.default is not dataclasses.MISSING:
        value = field.default
    elif field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    else:
        return "**needed**"
    if value is None:
        return "–"
    if dataclasses.is_dataclass(value):
        return "see its table"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        if value and dataclasses.is_dataclass(value[0]):
            return "see its table"
        value = list(value)
    return f"`{value}`" if str(value) else '`""`'


def _table_of(kind: Any) -> type[Any] | None:
    """The record behind a key that is a table."""
    for one in (kind, *typing.get_args(kind)):
        if dataclasses.is_dataclass(one) and isinstance(one, type):
            return one
    return None


def keys(record: type[Any], path: str = "") -> list[str]:
    """Markdown of a record's keys, then of the tables below it."""
    hints, texts = (
        typing.get_type_hints(record, include_extras=True),
        record_fields.describe_fields(record),
    )
    lead = (inspect.getdoc(record) or "").split("\n\n")[0].replace("\n", " ")
    lines = [f"### `[{path}]`" if path else "### Top level", "", lead, ""]
    lines += ["| key | kind | default | |", "|---|---|---|---|"]
    below: list[str] = []
    for field in dataclasses.fields(record):
        kind = hints[field.name]
        inner = _table_of(kind)
        word = (
            f"table `[{f'{path}.' if path else ''}{field.name}]`"
            if inner
            else _word(kind)
        )
        lines.append(
            f"| `{field.name}` | {word} | {_default(field)} | {texts.get(field.name, '')} |"
        )
        if inner is not None:
            below += ["", *keys(inner, f"{path}.{field.name}" if path else field.name)]
    return [*lines, *below]


def settings_page(name: str) -> str:
    """Every key of one settings file."""
    module, record, verb = SETTINGS[name]
    tables = keys(getattr(importlib.import_module(module), record))
    return "\n".join(
        [
            f"# {name}",
            "",
            f"Read by `metalens {verb}`. An unknown key is refused."
            + (" [Presets](presets.md) side by side." * (name == "RUN.toml")),
            "",
            *tables,
            "",
        ]
    )


def _options(verb: str, module: str) -> list[str]:
    loaded = importlib.import_module(module)
    parts = getattr(loaded, "PARTS", None)
    if parts:
        return [
            line
            for part, (where, _) in parts.items()
            for line in _options(f"{verb} {part}", where)
        ]
    record = loaded.Options
    texts, hints = (
        record_fields.describe_fields(record),
        typing.get_type_hints(record, include_extras=True),
    )
    for base in reversed(record.__mro__[1:-1]):
        if dataclasses.is_dataclass(base):
            texts = record_fields.describe_fields(base) | texts
    lines = [
        f"## metalens {verb}",
        "",
        (loaded.__doc__ or "").strip(),
        "",
        "| option | kind | default | |",
        "|---|---|---|---|",
    ]
    for field in dataclasses.fields(record):
        flag = _flag(field.name, hints[field.name])
        if flag is None:
            continue
        row = f"| {flag} | {_word(hints[field.name])} | {_default(field)} | {texts.get(field.name, '')} |"
        lines.append(row)
    return [*lines, ""]


def commands_page() -> str:
    """Every verb with its options."""
    lines = [
        "# Commands",
        "",
        "Every command ends 0 on success, 1 when a result fails its own check, 2 on bad input.",
        "",
    ]
    for verb, (module, _) in VERBS.items():
        lines += _options(verb, module)
    return "\n".join(lines)


def presets_page() -> str:
    """Values of every preset of RUN.toml, side by side."""
    run = importlib.import_module("codesign.train.run")
    names = [n for n in typing.get_args(run.Preset) if n != "none"]
    flat = [dict(_flatten(run.preset_table(name))) for name in names]
    rows = [
        f"| `{key}` | " + " | ".join(_value(values.get(key)) for values in flat) + " |"
        for key in dict.fromkeys(key for values in flat for key in values)
        if key != "preset"
    ]
    return "\n".join(
        [
            "# Presets of RUN.toml",
            "",
            "A preset gives every value that the file leaves out; an empty cell is the "
            "default of [RUN.toml](run.md).",
            "",
            "| key | " + " | ".join(f"`{name}`" for name in names) + " |",
            "|---" * (1 + len(names)) + "|",
            *rows,
            "",
        ]
    )


def _flatten(table: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{path}{key}.")
        else:
            yield path + key, value


def _value(value: Any) -> str:
    if value is None:
        return ""
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def materials_page() -> str:
    """Names of the built-in materials, the wavelengths they cover and their source."""
    materials = importlib.import_module("metalens.materials")
    lines = [
        "# Materials",
        "",
        "Names for `pillar`, `substrate`, `cover` and films; a CSV file (wavelength in "
        "um, n, k) or a page of refractiveindex.info (.yml) serves as well.",
        "",
        "| name | wavelengths / um | source |",
        "|---|---|---|",
    ]
    for name in materials.NAMES:
        material = materials.find_material(name)
        low, high = material.range_um
        span = "all" if high == float("inf") else f"{low:g} to {high:g}"
        source = " ".join(material.source.replace("|", "\\|").split())
        lines.append(f"| `{name}` | {span} | {source} |")
    return "\n".join([*lines, ""])


def fit_page() -> str:
    """Parameters of the fit: meaning, prior, bounds, and when each is fitted."""
    parameters = importlib.import_module("characterize.model.parameters")
    lines = [
        "# Parameters of the fit",
        "",
        "The last part of a name is its unit. [METROLOGY.toml](metrology.md) states "
        "values and asks for more of them to be fitted. Prior: standard deviation "
        "where nothing is stated.",
        "",
        "| name | meaning | prior | bounds | fitted |",
        "|---|---|---|---|---|",
    ]
    for row in parameters.PARAMETERS:
        bounds = "–" if row.high == float("inf") else f"{row.low:g} to {row.high:g}"
        prior = "none" if row.unstated == float("inf") else f"{row.unstated:g}"
        fitted = "yes" if row.free else "on request"
        meaning = row.meaning.replace("|", "\\|")
        lines.append(f"| `{row.name}` | {meaning} | {prior} | {bounds} | {fitted} |")
    return "\n".join([*lines, ""])


def reference_pages() -> dict[str, str]:
    """Text of every reference page by its file name in docs/reference."""
    settings = {
        f"{name.removesuffix('.toml').lower()}.md": settings_page(name)
        for name in SETTINGS
    }
    pages = settings | {
        "commands.md": commands_page(),
        "presets.md": presets_page(),
        "materials.md": materials_page(),
        "fit.md": fit_page(),
    }
    return {
        name: re.sub(r":\w+:`~?([\w.]+)`", r"`\1`", text)
        for name, text in pages.items()
    }


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links from docs/ to the pages of the root, as the site has them."""
    return re.sub(
        r"\]\(\.\./([A-Z]+)\.md\)", lambda m: f"]({m[1].lower()}.md)", markdown
    )


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the root to the site."""
    root = Path(config.config_file_path).parent
    pages = {}
    for name in ("README", "ARCHITECTURE", "CONTRIBUTING", "CHANGELOG"):
        text = (root / f"{name}.md").read_text(encoding="utf-8")
        text = re.sub(r"\]\(docs/(\w[^)]*)\)", r"](\1)", text)
        where = "index.md" if name == "README" else f"{name.lower()}.md"
        pages[where] = re.sub(
            r"\]\((ARCHITECTURE|CONTRIBUTING|CHANGELOG)\.md\)",
            lambda m: f"]({m[1].lower()}.md)",
            text,
        )
    for where, text in pages.items():
        files.append(File.generated(config, where, content=text))
    return files


if __name__ == "__main__":
    folder = Path(__file__).resolve().parents[1] / "reference"
    for file_name, page_text in reference_pages().items():
        (folder / file_name).write_text(page_text, encoding="utf-8")
