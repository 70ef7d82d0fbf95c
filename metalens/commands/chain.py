"""The chain as a list of commands: the stages that a set of settings files asks for,
and what each leaves.
"""

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any

from metalens.core import config, reading, store
from metalens.core.errors import ConfigError

MADE = ("library.h5", "lens.h5", "bench_lens.h5", "asbuilt.h5")  # by the chain itself
SHIPPED = ("cell", "design", "process", "run", "bench_truth", "bench_metrology")


@dataclass(frozen=True, slots=True)
class ChainFiles:
    """CHAIN.toml: settings files, relative to it; a stage whose file is left out is not
    run.

    cell, design, process: of library, lens and mask. psf: of the PSF stack; its
        defaults without it.
    run: of a co-design run. bench_truth, bench_metrology: hidden errors and other
        measurements of a virtual bench; it measures the lens of the run, which is then
        retrained for, or without a run the one of bench_design.
    budget: whether the error budget is computed.
    bench_design: lens that the virtual bench measures, where it is not the run's or the
        design's.
    """

    cell: Path
    design: Path
    process: Path
    psf: Path | None = None
    bench_design: Path | None = None
    bench_truth: Path | None = None
    bench_metrology: Path | None = None
    run: Path | None = None
    budget: bool = True

    def __post_init__(self) -> None:
        """Refuse a bench without one lens, and a lens without a bench.

        Raises:
            ConfigError: with what is needed.
        """
        given = (self.bench_design is not None) + (self.run is not None)
        if given != 1 if self.bench_truth else self.bench_design is not None:
            raise ConfigError(
                "bench_truth measures one lens: that of a run, or bench_design without a run"
            )


@dataclass(frozen=True, slots=True)
class ChainStage:
    """One verb of the chain.

    words: of the command line, relative to the chain's folder. error: entry of the
    result that says how wrong it may
    be, and what it means. pictures: files that the verb leaves, with captions.
    """

    title: str
    text: str
    words: tuple[str, ...]
    error: Sequence[str]
    pictures: Sequence[Sequence[str]] = ()


@dataclass(frozen=True, eq=False, slots=True)
class ChainInputs:
    """What a chain's folder holds before its first stage.

    files: the settings, by name in the folder. contents: {path in the folder: bytes} of
    them and all that they name.
    """

    files: ChainFiles
    contents: dict[str, bytes]

    def write(self, folder: Path) -> None:
        """Put them into the folder."""
        for name, content in self.contents.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            store.write_bytes(folder / name, content)

    def stands_in(self, folder: Path) -> bool:
        """Whether a folder holds exactly these settings, and the same tables and maps.

        Args:
            folder: of a chain.
        """
        settings = {
            name for name in self.contents if "/" not in name and name.endswith(".toml")
        }
        files = [(folder / name, content) for name, content in self.contents.items()]
        return settings == {path.name for path in folder.glob("*.toml")} and all(
            path.is_file() and path.read_bytes() == content for path, content in files
        )


def shipped_settings() -> ChainFiles:
    """The demo's own settings, as names of files that :func:`lay_out_inputs` gives."""
    return _chain_files(
        SHIPPED, budget=False
    )  # a minute more: asked for with a CHAIN.toml, or metalens budget


def load_chain(path: Path) -> ChainFiles:
    """Read CHAIN.toml.

    Args:
        path: of CHAIN.toml.

    Raises:
        ConfigError: see :func:`metalens.core.config.load`; a settings file that does
        not
            exist.
    """
    files = config.load(path, ChainFiles)
    for name, value in _settings_files(files):
        if not (path.parent / value).is_file():
            raise ConfigError(
                f"{path}: {name} = {str(value)!r}: no such file beside it"
            )
    return files


def lay_out_inputs(
    files: ChainFiles, source: Path | None, *, aperture_mm: float | None
) -> ChainInputs:
    """Settings files under plain names, with the tables and maps that they name.

    Args:
        files: settings files of the stages.
        source: folder of the files; None for the shipped ones.
        aperture_mm: in place of the aperture of the design; None leaves it.

    Raises:
        ConfigError: a file that is named lies above its settings file, or two files
        have
            one name.
    """
    contents: dict[str, bytes] = {}
    for name, value in _settings_files(files):
        if source is None:
            text = (
                resources.files("metalens")
                .joinpath("data", "demo", value.name)
                .read_text(encoding="utf-8")
            )
        else:
            _add_named_files(
                contents, source / value
            )  # refuses what is no settings file
            text = reading.read_text(source / value)
        if name == "design" and aperture_mm is not None:
            lines = [
                line for line in text.splitlines() if not line.startswith("aperture_mm")
            ]
            text = "\n".join([f"aperture_mm = {aperture_mm}", *lines]) + "\n"
        contents[f"{name}.toml"] = text.encode()
    return ChainInputs(
        _chain_files(
            tuple(name for name, _ in _settings_files(files)), budget=files.budget
        ),
        contents,
    )


def _add_named_files(contents: dict[str, bytes], settings: Path) -> None:
    """Add the files that a settings file names to ``contents``, by their relative
    names.

    They lie in its folder, below it, or in the current folder. Absolute paths and files
    that the chain makes are left out.

    Args:
        contents: bytes by name.
        settings: the settings file.

    Raises:
        ConfigError: a name with "..", or two files of one name.
    """
    for name in sorted(set(_file_names(config.read(settings, ChainFiles)))):
        matches = [
            folder / name
            for folder in (settings.parent, Path())
            if (folder / name).is_file()
        ]
        if Path(name).is_absolute() or name in MADE or not matches:
            continue
        if ".." in Path(name).parts:
            raise ConfigError(
                f"{settings}: {name!r} lies above it; put it beside it, or give its whole path"
            )
        content = matches[0].read_bytes()
        if contents.setdefault(Path(name).as_posix(), content) != content:
            raise ConfigError(
                f"{settings}: {name!r} is not the file of that name beside other settings; rename it"
            )


def _file_names(value: Any) -> Iterator[str]:
    """Strings anywhere in a table that may name a file: with an ending, of one line."""
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _file_names(part)
    elif isinstance(value, str) and Path(value).suffix and value.isprintable():
        yield value


def _chain_files(names: tuple[str, ...], *, budget: bool = True) -> ChainFiles:
    """Settings files of the chain under plain names, ``NAME.toml``."""
    entries: dict[str, Any] = {name: Path(f"{name}.toml") for name in names}
    return ChainFiles(**entries, budget=budget)


def _settings_files(files: ChainFiles) -> Iterator[tuple[str, Path]]:
    """Name and path of every settings file of a chain."""
    for field in fields(files):
        value = getattr(files, field.name)
        if isinstance(value, Path):
            yield field.name, value


def chain_stages(files: ChainFiles) -> Iterator[ChainStage]:
    """The stages of data/stages.toml that the settings files ask for, in order.

    Args:
        files: settings files of the stages.
    """
    text = resources.files("metalens").joinpath("data", "stages.toml")
    stated = {field.name for field in fields(files) if getattr(files, field.name)}
    parts = {
        "psf": "--config psf.toml" if files.psf else "",
        "metrology": "--metrology bench_metrology.toml"
        if files.bench_metrology
        else "",
        "measured": "bench_lens.h5" if files.bench_design else "run/lens.h5",
    }
    for stage in tomllib.loads(text.read_text("utf-8"))["stage"]:
        needs, without = (set(stage.pop(key, ())) for key in ("needs", "without"))
        if needs <= stated and not without & stated:
            words = tuple(stage.pop("words").format(**parts).split())
            yield ChainStage(words=words, **stage)
