"""A page to explore any artefact: lens, library, PSF stack, as-built lens and more; opens without a server."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import tyro

from metalens.commands.common import Common, MaybeOutput
from metalens.ground import store
from metalens.ground.errors import ConfigError
from metalens.view import Panel, write

VIEWS: dict[str, str] = {}  # kind of artefact: "module:function" of a package above, filled by the command line
OWN = {"library": "library_panels", "lens": "lens_panels", "psf": "psf_panels"}


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens view``.

    Attributes:
        file: an artefact: library.h5, lens.h5, psf.h5, asbuilt.h5 or another HDF5 file of the toolchain.
        output: the page to write; by default the file's name with .html, beside it.
    """

    file: tyro.conf.Positional[Path]
    output: MaybeOutput = None


def run(options: Options) -> int:
    """Write the page; exit 0."""
    if options.file.is_dir():
        raise ConfigError(f"{options.file} is a folder; give one of its files")
    target = options.output or options.file.with_suffix(".html")
    with options.claim(target) as draft:
        kind, about = head(options.file)
        panels = panels_of(kind)(options.file)
        write(draft.path, f"{options.file.name} ({kind})", panels, about=about)
    size = target.stat().st_size
    options.console.result(
        {"page": target.name, "panels": len(panels), "bytes": size},
        f"{target}: {len(panels)} figures of {options.file.name}, {size / 1e6:.2g} MB; open it in a browser",
    )
    return 0


def head(path: Path) -> tuple[str, dict[str, object]]:
    """Kind of a file, and where it comes from."""
    stored = store.load(path)
    made = stored.provenance
    return stored.kind, {
        "made with": ", ".join(f"{k} {v}" for k, v in made.versions.items()),
        "from": {name: digest for name, digest in made.inputs.items()},
        "settings": made.config,
    }


def panels_of(kind: str) -> Callable[[Path], list[Panel]]:
    """What shows a kind of artefact; any other kind is shown plainly."""
    module, _, function = VIEWS.get(kind, "").partition(":")
    if not module:
        module, function = "metalens.view.artefacts", OWN.get(kind, "plain_panels")
    found: Callable[[Path], list[Panel]] = getattr(importlib.import_module(module), function)
    return found
