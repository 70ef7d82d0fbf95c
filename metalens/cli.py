"""The ``metalens`` command: one verb a stage. Exit 0 on success, 1 when a result fails
its own check, 2 on bad input.
"""

import atexit
import dataclasses
import importlib
import io
import math
import os
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Sequence
from typing import Any

from metalens.core import report
from metalens.core.errors import (
    ConfigError,
    FitRefused,
    MetalensError,
    missing_extra,
    nearest_name_hint,
)

SUCCESS, FAILED_CHECK, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

# verb: (module that holds ``Options``, and ``run`` or the name of the module that has
# it, ``WORK``; one line of help)
VERBS: dict[str, tuple[str, str]] = {
    "library": (
        "metalens.commands.library",
        "CELL.toml -> library.h5: pillar sweep with an error bar on every entry",
    ),
    "study": (
        "metalens.commands.study",
        "which pitch and height cover a full turn: table, JSON and figure",
    ),
    "field": (
        "metalens.commands.field",
        "CELL.toml -> field.h5: E and H in and around one pillar, with a picture",
    ),
    "design": (
        "metalens.commands.design",
        "DESIGN.toml -> lens.h5: hyperbolic, double helix, cubic, Fisher, own map",
    ),
    "psf": (
        "metalens.commands.psf",
        "lens.h5 or asbuilt.h5 -> psf.h5: PSF stack over depth, angle, wavelength, with plots",
    ),
    "lens-report": (
        "codesign.commands.options.lens_report",
        "lens.h5 -> a page over field and wavelength: MTF, distortion, efficiency by cause",
    ),
    "export": (
        "metalens.commands.export",
        "lens.h5 -> NPZ, MATLAB or Zemax grid phase for other programs",
    ),
    "scene": (
        "codesign.commands.options.scene",
        "SCENE.toml -> rendered eyes: contact sheet, labels",
    ),
    "evaluate": (
        "codesign.commands.evaluate",
        "optics and more: the paper's tables and figures for your own files",
    ),
    "layout": (
        "layout.commands.layout",
        "lens.h5 -> mask (OASIS, GDSII, DXF, STEP, STL), checked, with report",
    ),
    "check": (
        "layout.commands.check",
        "MASK.gds|oas + PROCESS.toml -> design rules on a mask made anywhere",
    ),
    "dose": (
        "layout.commands.dose",
        "MASK.gds|oas + PROCESS.toml -> proximity-corrected doses for any polygons",
    ),
    "capture": (
        "characterize.commands.capture_options",
        "lens.h5 -> capture folder of a hidden as-built lens on a virtual bench",
    ),
    "measure": (
        "characterize.commands.measure",
        "CAPTURES or MICROGRAPH -> MTF, Strehl, spot sizes; or every pillar's diameter and a bias table",
    ),
    "fit": (
        "characterize.commands.fit_options",
        "CAPTURE -> as-built lens or pupil with intervals, and a report",
    ),
    "codesign": (
        "codesign.commands.options.codesign",
        "RUN.toml -> RUN_DIR: lens, pixel pitch and network trained together",
    ),
    "retrain": (
        "codesign.commands.options.retrain",
        "RUN_DIR + asbuilt.h5 -> network for the lens as built, the next mask",
    ),
    "budget": (
        "codesign.commands.options.budget",
        "lens.h5 -> error of every link of the chain: phase, PSF, gaze",
    ),
    "demo": (
        "metalens.commands.demo",
        "the chain on a small lens, ending in report.html",
    ),
    "view": (
        "metalens.commands.view",
        "one self-contained page to explore any artefact",
    ),
    "info": (
        "metalens.commands.info",
        "kind, version, provenance and arrays of any artefact",
    ),
}

# modules of the packages above that commands load by name: the printable limits of
# PROCESS.toml; the summary of a mask
ABOVE = {"process": "layout.process.limits", "mask": "layout.commands.info"}
# source of ``metalens psf`` by kind of file: record whose ``load`` gives its design and
# its PSFs
PSF_SOURCES = {"asbuilt": "characterize.inference:AsBuilt"}
# what ``metalens view`` shows of a kind: "module:function" with its panels
VIEWS = {
    "mask": "layout.commands.view:mask_panels",
    "capture": "characterize.commands.view:capture_panels",
    "asbuilt": "characterize.commands.view:asbuilt_panels",
    "pupil": "characterize.commands.view:pupil_panels",
    "run": "codesign.commands.view:run_panels",
    "scene": "codesign.commands.view:scene_panels",
    "image": "codesign.commands.view:image_panels",
    "answers": "codesign.commands.view:prediction_panels",
    "budget": "codesign.commands.view:budget_panels",
}
# files that a verb reads a part of, and who knows the whole: "module:function" that
# refuses it
WHOLE = {
    "budget": {"process": "layout.process.process:load_process"},
    "retrain": {"process": "layout.process.process:load_process"},
}

_LARGEST = 1e9  # size of a number among options, in its unit


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit status.

    Args:
        arguments: words of the command line.
    """
    try:
        status = _main(arguments)
    except KeyboardInterrupt:  # before the verb began
        status = _refuse("interrupted before the work began", INTERRUPTED)
    try:
        report.flush_output()
    except MetalensError as error:
        status = _refuse(str(error))
    return status


def _main(arguments: Sequence[str] | None) -> int:
    """Handle help, version and unknown commands, else run the verb; the exit status.

    Args:
        arguments: words of the command line; None for those of the process.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a locale of ASCII alone
    if not words or words[0] in ("-h", "--help"):
        report.flush_output(_help(VERBS) + _INTERRUPTED)
        return SUCCESS if words else BAD_INPUT
    if words[0] == "--version":
        from metalens import __version__

        report.flush_output(f"metalens {__version__}\n")
        return SUCCESS
    if words[0] not in VERBS:
        return _refuse(
            f"unknown command {words[0]!r}{nearest_name_hint(words[0], VERBS)}"
        )
    _prepare()
    return _guarded(words, debug=debug)


def _prepare() -> None:
    """Set signals and the environment of the process for a command."""
    # a lost terminal ends a command as Ctrl-C does, unless under nohup
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _stop)
    # Waiting threads of OpenMP release their core early: spinning by default makes
    # training ten times slower next to another busy program, and alone a tenth faster.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    _numba_cache()


def _guarded(words: list[str], *, debug: bool) -> int:
    """Run the command; its exit status, with one line on stderr for any error.

    Args:
        words: of the command line.
        debug: show the traceback too.
    """
    from metalens.core import store

    token = store.COMMAND.set(" ".join(words))
    try:
        return _dispatch(words[0], words[1:])
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 (the one handler at the top)
        if debug:
            traceback.print_exc()
        message, status = _verdict(error)
        return _refuse("; ".join([message, *getattr(error, "__notes__", ())]), status)
    finally:
        store.COMMAND.reset(token)


def _verdict(error: BaseException) -> tuple[str, int]:
    """(one line, exit status) for an error of a command."""
    if isinstance(error, KeyboardInterrupt):
        text = "interrupted; the output is as it was before, or new if it was finished"
        return text, INTERRUPTED
    if isinstance(error, ModuleNotFoundError) and (hint := missing_extra(error)):
        return hint, BAD_INPUT
    if isinstance(error, MetalensError | OSError):
        refused = isinstance(error, FitRefused)
        return str(error), FAILED_CHECK if refused else BAD_INPUT
    line = " ".join(str(error).split())[:300]
    unforeseen = f"{type(error).__name__}: {line}; not foreseen: --debug shows where"
    return unforeseen, BAD_INPUT


def _numba_cache() -> None:
    """Set a temporary cache of compiled loops where neither package nor home is
    writable.
    """
    here, home = os.path.dirname(__file__), os.path.expanduser("~")
    if (
        "NUMBA_CACHE_DIR" in os.environ
        or os.access(here, os.W_OK)
        or os.access(home, os.W_OK)
    ):
        return
    os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="metalens-numba-")
    atexit.register(shutil.rmtree, os.environ["NUMBA_CACHE_DIR"], ignore_errors=True)


def _dispatch(verb: str, words: list[str]) -> int:
    """Parse the options of a verb and run it; the exit status.

    Args:
        verb: name of the verb.
        words: of the command line after it.
    """
    import tyro

    module = importlib.import_module(VERBS[verb][0])
    parts: dict[str, tuple[str, str]] = getattr(module, "PARTS", {})
    if parts:
        if not words or words[0] in ("-h", "--help"):
            report.flush_output(_help(parts, f"metalens {verb}"))
            return SUCCESS if words else BAD_INPUT
        part = words[0] if words[0] in parts else module.part_of(words[0])
        if part is None:
            return _refuse(
                f"unknown command {verb} {words[0]!r}{nearest_name_hint(words[0], parts)}"
            )
        module = importlib.import_module(parts[part][0])
        verb, words = f"{verb} {part}", words[words[0] in parts :]
    if verb == "psf":
        module.SOURCES.update(PSF_SOURCES)
    try:
        options: Any = tyro.cli(
            module.Options,
            args=words,
            prog=f"metalens {verb}",
            description=module.__doc__,
        )
    except BrokenPipeError:  # whoever was shown the help went away
        report.silence_output()
        return SUCCESS
    _check_numbers(options)
    for name, where in WHOLE.get(verb, {}).items():
        if getattr(options, name) is not None:
            source, _, function = where.partition(":")
            load = getattr(importlib.import_module(source), function)
            load(getattr(options, name))
    work = importlib.import_module(getattr(module, "WORK", module.__name__))
    return int(work.run(options))


def _check_numbers(options: Any) -> None:
    """Refuse numbers among the options that are not finite or above 1e9.

    As :func:`metalens.core.config.load` does for settings files; infinity stays where
    the option allows it.

    Raises:
        ConfigError: naming the option.
    """
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if repr(value) == repr(field.default):
            continue
        for number in value if isinstance(value, tuple) else (value,):
            collimated = number == math.inf and field.metadata.get("may_be_inf")
            if (
                isinstance(number, float)
                and not abs(number) <= _LARGEST
                and not collimated
            ):
                name = field.name.replace("_", "-")
                raise ConfigError(
                    f"--{name} {number:g}: need a finite number of at most {_LARGEST:g} in size"
                )


def load_above(name: str) -> Any:
    """The module of :data:`ABOVE` with this name."""
    return importlib.import_module(ABOVE[name])


def _help(verbs: dict[str, tuple[str, str]], name: str = "metalens") -> str:
    rows = "\n".join(f"  {verb:<10} {summary}" for verb, (_, summary) in verbs.items())
    return (
        f"usage: {name} COMMAND ... ({name} COMMAND --help for its options; --debug shows where an error came from)\n\n"
        f"{rows}\n"
    )


_INTERRUPTED = """
An interrupted command leaves what stood at its output. library, study and evaluate paper go on with the same
command, codesign, retrain and demo with --resume; all others begin anew.
"""


def _refuse(message: str, status: int = BAD_INPUT) -> int:
    sys.stderr.write(f"metalens: error: {message}\n")
    return status


def _stop(number: int, frame: object) -> None:
    raise KeyboardInterrupt
