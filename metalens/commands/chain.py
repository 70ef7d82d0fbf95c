"""The chain as a list of commands: the stages that a set of settings files asks for,
and what each leaves.
"""

from collections.abc import Iterator
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
        """Refuse a bench without a lens, and a bench_design next to a run.

        Raises:
            ConfigError: with what is needed.
        """
        if self.bench_design is not None and (
            self.bench_truth is None or self.run is not None
        ):
            raise ConfigError(
                "bench_design belongs to a bench_truth without a run: a run's bench measures its own lens"
            )
        if (
            self.bench_truth is not None
            and self.bench_design is None
            and self.run is None
        ):
            raise ConfigError(
                "bench_truth has no lens to measure: give a run or a bench_design"
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
    error: tuple[str, str]
    pictures: tuple[tuple[str, str], ...] = ()


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
    """The chain, in order.

    Args:
        files: settings files of the stages.
    """
    yield from _design_stages(files)
    if files.run:
        yield _codesign()
    if files.budget:
        yield _budget(files)
    if files.bench_truth:
        yield from _bench_stages(files)
        if files.run:
            yield _retrain()


def _design_stages(files: ChainFiles) -> Iterator[ChainStage]:
    """Stages of library, lens, PSFs and mask.

    Args:
        files: settings files; PSFs have defaults without one.
    """
    yield ChainStage(
        "Pillar library",
        "Rigorous solves of one pillar cell over the diameter, joined by a rational function, with an error bar on "
        "every entry, and the polynomial proxy (paper Eq. 2) that every later stage uses.",
        ("library", "cell.toml", "-o", "library.h5"),
        ("max_error", "largest error bar of |t|"),
        (("library.png", "Phase and transmission of the pillars with error bars."),),
    )
    yield ChainStage(
        "Lens",
        "Every site takes the printable diameter whose phase is the wanted one. A direct Rayleigh-Sommerfeld sum "
        "over all pillars then shows where the light really meets.",
        ("design", "design.toml", "-o", "lens.h5"),
        ("max_phase_error_rad", "rad between target and assigned phase"),
        (("lens.png", "Phase of the pillars across the lens."),),
    )
    yield ChainStage(
        "Point spread functions",
        "Images of point sources over the depths of an eye, computed on the sensor window only, to a stated error.",
        (
            "psf",
            "lens.h5",
            "-o",
            "psf.h5",
            *(("--config", "psf.toml") if files.psf else ()),
        ),
        ("error", "relative error of the PSFs"),
        (
            ("psf_xz.png", "Slice through the PSF along depth."),
            ("psf_montage.png", "PSFs over depth and field angle."),
            ("psf_mtf.png", "Modulation transfer, and energy inside a circle."),
        ),
    )
    yield _mask()


def _mask() -> ChainStage:
    """Stage of the mask."""
    return ChainStage(
        "Mask",
        "One cell per diameter, polygons of equal area on the mask grid, aperture, marks, label, dose test and "
        "witness cells; checked against the design rules, written, read back and compared.",
        (
            "layout",
            "lens.h5",
            "--process",
            "process.toml",
            "-o",
            "mask",
            "--oasis",
            "--gds",
        ),
        ("differences", "differences between plan and written files"),
        (
            ("mask/die.png", "The whole die."),
            ("mask/pillars.png", "Single pillars as polygons of the mask."),
            ("mask/diameters.png", "How many pillars of each diameter."),
        ),
    )


def _budget(files: ChainFiles) -> ChainStage:
    """Stage of the error budget, with the gaze error where there is a run.

    Args:
        files: settings files; their run has the network that reads gaze.
    """
    lens = (
        ("run/lens.h5", "--run", "run")
        if files.run
        else ("lens.h5", "--library", "library.h5")
    )
    error = ("gaze_error_deg", "deg of gaze from all links together")
    if not files.run:
        error = ("psf_error", "relative error of the PSFs from all links together")
    return ChainStage(
        "Error budget",
        "Every link from pillar to answered gaze, each changed or switched off alone on the frames of the virtual "
        "experiment, and their sum beside the error that the experiment measures there. Without a network nothing reads "
        "gaze: phase and PSF alone have errors.",
        ("budget", *lens, "--process", "process.toml", "-o", "budget.h5"),
        error,
        (("budget.png", "Gaze error of each link, log scale."),),
    )


def _bench_stages(files: ChainFiles) -> Iterator[ChainStage]:
    """Stages of the virtual bench: its lens where it has its own, captures and their
    fit.

    Args:
        files: settings files, with ``bench_truth``.
    """
    metrology = ("--metrology", "bench_metrology.toml") if files.bench_metrology else ()
    if files.bench_design:
        yield ChainStage(
            "A lens for the bench",
            "A small sister of the lens, of the same pillars, with hidden fabrication errors, to be measured.",
            ("design", "bench_design.toml", "-o", "bench_lens.h5"),
            ("max_phase_error_rad", "rad between target and assigned phase"),
        )
    measured = "bench_lens.h5" if files.bench_design else "run/lens.h5"
    yield ChainStage(
        "Captures",
        "A virtual bench: the lens is made with errors that the fit never sees, and shot through focus with the noise "
        "of a real sensor.",
        ("capture", measured, "--truth", "bench_truth.toml", "-o", "captures"),
        ("peak_e", "electrons in the brightest pixel"),
    )
    yield ChainStage(
        "The lens as built",
        "Captures to parameters with their intervals; what the frames cannot separate is said in words.",
        (
            "fit",
            "captures",
            "--design",
            measured,
            "--truth",
            "bench_truth.toml",
            *metrology,
            "-o",
            "asbuilt.h5",
        ),
        (
            "chi2_per_dof",
            "chi² per degree of freedom, 1 where model and noise explain the frames",
        ),
        (
            (
                "asbuilt_frames.png",
                "As designed, measured, as built, and the residual in standard deviations.",
            ),
            (
                "asbuilt_posterior.png",
                "Posterior of each parameter, its 95 % interval, and in red the hidden truth.",
            ),
            ("asbuilt_parameters.png", "Fitted parameters with their 95 % intervals."),
        ),
    )


def _codesign() -> ChainStage:
    """Stage of the co-design run."""
    return ChainStage(
        "Co-design",
        "A small network trained through the lens on rendered eyes: pupil, depth of every part of the image from its "
        "blur, slippage from both with its uncertainty; then searched under compute budgets. Two minutes on two cores.",
        ("codesign", "run.toml", "-o", "run"),
        ("error", "see the rows"),
        (("run/pareto.png", "Accuracy against compute."),),
    )


def _retrain() -> ChainStage:
    """Stage of retraining for the fitted lens."""
    words = (
        "retrain",
        "run",
        "--optics",
        "asbuilt.h5",
        "--truth",
        "bench_truth.toml",
        "--process",
        "process.toml",
    )
    return ChainStage(
        "Before and after retraining",
        "The network is trained on for lenses drawn from the fit's posterior, and judged on the lens that was really "
        "made. In a study of a hundred hidden lenses of 1 mm before a larger network (docs/results.md) the slippage error "
        "rose from 0.44 mm to 0.59 mm in the median, and retraining won it back.",
        (
            *words,
            "--steps",
            "60",
            "--draws",
            "4",
            "--test-batches",
            "8",
            "-o",
            "retrained",
        ),
        ("slip_mm", "mm of slippage error after retraining"),
        (
            (
                "retrained/cases.png",
                "Slippage error with the lens as designed, as made, and after retraining.",
            ),
        ),
    )
