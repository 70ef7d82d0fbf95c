"""The ``metalens`` command: one verb a stage. Exit 0 on success, 1 when a result fails its own check, 2 on bad input.

A verb lives beside its stage, as a frozen dataclass of its options and a function ``run(options) -> int``; only
the verb that is asked for is imported. A module with a table ``PARTS`` in place of them has verbs of its own; its
``part_of(word)`` may name the one that a path is meant for.
"""

import importlib
import os
import signal
import sys
from collections.abc import Sequence
from typing import Any

from metalens.errors import FitRefused, MetalensError, nearest

SUCCESS, FAILED_CHECK, BAD_INPUT = 0, 1, 2

# verb: (module that holds ``Options`` and ``run``, one line of help)
VERBS: dict[str, tuple[str, str]] = {
    "library": (
        "metalens.commands.library",
        "CELL.toml -> library.h5: pillar sweep with an error bar on every entry",
    ),
    "study": ("metalens.commands.study", "which pitch and height cover a full turn: table, JSON and figure"),
    "design": (
        "metalens.commands.design",
        "DESIGN.toml -> lens.h5: hyperbolic, double helix, cubic, Fisher, own map",
    ),
    "psf": (
        "metalens.commands.psf",
        "lens.h5 -> psf.h5: PSF stack over depth, angle, wavelength, with plots",
    ),
    "scene": ("codesign.command_scene", "SCENE.toml -> rendered eyes: contact sheet, layers, labels"),
    "evaluate": ("codesign.command_evaluate", "optics and more: the paper's tables and figures for your own files"),
    "layout": ("layout.command", "lens.h5 -> mask (OASIS, GDSII, DXF, STEP, STL), checked, with report"),
    "capture": (
        "characterize.command_capture",
        "lens.h5 -> capture folder of a hidden as-built lens on a virtual bench",
    ),
    "fit": ("characterize.command_fit", "CAPTURE -> as-built lens or pupil with intervals, and a report"),
    "codesign": ("codesign.command_codesign", "RUN.toml -> RUN_DIR: lens, pixel pitch and network trained together"),
    "retrain": ("codesign.command_retrain", "RUN_DIR + asbuilt.h5 -> network for the lens as built, and the next mask"),
    "budget": ("codesign.command_budget", "lens.h5 -> error of every link of the chain: phase, PSF, gaze"),
    "plan": ("codesign.command_plan", "a gaze error -> the tolerances, depths and wavelengths that suffice"),
    "demo": ("metalens.commands.demo", "the chain on a small lens, ending in report.html"),
    "info": ("metalens.commands.info", "kind, version, provenance and a small picture of any artefact"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        sys.stdout.write(_help(VERBS))
        return SUCCESS if words else BAD_INPUT
    if words[0] == "--version":
        from metalens import __version__

        sys.stdout.write(f"metalens {__version__}\n")
        return SUCCESS
    if words[0] not in VERBS:
        return _refuse(f"unknown command {words[0]!r}{nearest(words[0], VERBS)}")
    signal.signal(signal.SIGTERM, _stop)
    # Threads of OpenMP that wait give their core away early: beside another busy program training is ten times slower
    # where they spin as long as they do by default; alone it is a tenth slower so.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    try:
        return _dispatch(words[0], words[1:])
    except FitRefused as error:
        return _refuse(str(error), FAILED_CHECK)
    except (MetalensError, OSError) as error:
        return _refuse(str(error))
    except KeyboardInterrupt:
        return _refuse("interrupted; nothing half-written is left", 130)


def _dispatch(verb: str, words: list[str]) -> int:
    import tyro

    module = importlib.import_module(VERBS[verb][0])
    parts: dict[str, tuple[str, str]] = getattr(module, "PARTS", {})
    if parts:
        if not words or words[0] in ("-h", "--help"):
            sys.stdout.write(_help(parts, f"metalens {verb}"))
            return SUCCESS if words else BAD_INPUT
        meant = words[0] if words[0] in parts else module.part_of(words[0])
        if meant is None:
            return _refuse(f"unknown command {verb} {words[0]!r}{nearest(words[0], parts)}")
        module = importlib.import_module(parts[meant][0])
        verb, words = f"{verb} {meant}", words[words[0] in parts :]
    options: Any = tyro.cli(module.Options, args=words, prog=f"metalens {verb}", description=module.__doc__)
    return int(module.run(options))


def _help(verbs: dict[str, tuple[str, str]], name: str = "metalens") -> str:
    rows = "\n".join(f"  {verb:<10} {summary}" for verb, (_, summary) in verbs.items())
    return f"usage: {name} COMMAND ... ({name} COMMAND --help for its options)\n\n{rows}\n"


def _refuse(message: str, status: int = BAD_INPUT) -> int:
    sys.stderr.write(f"metalens: error: {message}\n")
    return status


def _stop(number: int, frame: object) -> None:
    raise KeyboardInterrupt
