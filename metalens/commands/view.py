"""A page to explore any artefact: lens, library, PSF stack, as-built lens and more;
opens without a server.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import tyro

from metalens.cli import VIEWS
from metalens.commands.common import MASKS, CommonOptions, MaybeOutput
from metalens.core import store, transaction
from metalens.core.errors import ConfigError
from metalens.view import Panel, page_html

# kind of a folder by patterns of file names, any of which it holds
FOLDERS = {
    "mask": tuple(f"*{end}" for end in MASKS),
    "run": ("log.jsonl", "checkpoint.safetensors"),
    "capture": ("stage.csv", "stage.json", "capture.toml", "capture.json"),
}
GENERATOR = 'content="metalens toolchain"'  # in the head of these pages
_HEAD = 400  # characters of a page that include it
OWN = {
    "library": "library_panels",
    "axes-library": "axes_panels",
    "lens": "lens_panels",
    "psf": "psf_panels",
}


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens view``.

    Attributes:
        file: library.h5, lens.h5, psf.h5, asbuilt.h5 and most other HDF5 files of the
            toolchain; a mask (GDSII or OASIS);
            or the folder of a mask, of captures or of a co-design run.
        output: the page to write; by default the file's name with .html, next to it, or
            with _view.html where a report
            of that name stands there.
    """

    file: tyro.conf.Positional[Path]
    output: MaybeOutput = None


def run(options: Options) -> int:
    """Write the page; exit 0.

    Args:
        options: of the command line.
    """
    target = options.output or _default_page(options.file)
    with options.claim(target) as draft:
        kind = kind_of(options.file)
        title, panels = f"{options.file.name} ({kind})", panels_of(kind)(options.file)
        page = page_html(title, panels, about=_about(options.file))
        store.write_text(draft.path, page)
    size = target.stat().st_size
    options.console.result(
        {"page": target.name, "panels": len(panels), "bytes": size},
        f"{target}: {len(panels)} part{'s' * (len(panels) > 1)} of {options.file.name}, {size / 1e6:.2g} MB; open it "
        "in a browser",
    )
    return 0


def _default_page(path: Path) -> Path:
    """NAME.html in the folder of the artefact.

    NAME_view.html where NAME.html is another page, as the report of ``psf`` or ``fit``.
    """
    own = path.resolve() if not path.name else path
    target = own.with_name(own.name.removesuffix(".h5") + ".html")
    if not target.is_file():
        return target
    with open(target, encoding="utf-8", errors="replace") as file:
        head = file.read(_HEAD)
    return target if GENERATOR in head else target.with_name(f"{target.stem}_view.html")


def kind_of(path: Path) -> str:
    """Kind of an artefact: that of an HDF5 file, ``mask``, ``run`` or ``capture``.

    Args:
        path: of the file or folder.

    Raises:
        ConfigError: a folder of none of these kinds.
        StoreError: no artefact.
    """
    if not path.is_dir():
        return "mask" if path.suffix.lower() in MASKS else store.load(path).kind
    for kind, patterns in FOLDERS.items():
        if any(True for pattern in patterns for _ in path.glob(pattern)):
            return kind
    raise ConfigError(
        f"{path} is no folder of a mask, of captures or of a run; give one, or a file"
    )


def _about(path: Path) -> dict[str, object]:
    """Provenance of an artefact for its page: command or versions, inputs, settings."""
    if path.is_dir() or path.suffix != ".h5":
        manifest = (
            transaction.read_manifest(path if path.is_dir() else path.parent) or {}
        )
        return {name: manifest[name] for name in manifest if name != "files"}
    provenance = store.load(path).provenance
    return {
        "made with": ", ".join(f"{k} {v}" for k, v in provenance.versions.items()),
        "from": {name: digest for name, digest in provenance.inputs.items()},
        "settings": provenance.config,
    }


def panels_of(kind: str) -> Callable[[Path], list[Panel]]:
    """The function that makes the panels of a kind of artefact from its path.

    Args:
        kind: as :func:`kind_of` gives it.

    Raises:
        ConfigError: a kind without a page.
    """
    if kind not in VIEWS and kind not in OWN:
        raise ConfigError(
            f"no page shows files of kind {kind!r}; metalens info lists what they hold"
        )
    where = VIEWS.get(kind) or f"metalens.view.artefacts:{OWN[kind]}"
    module, _, function = where.partition(":")
    make_panels: Callable[[Path], list[Panel]] = getattr(
        importlib.import_module(module), function
    )
    return make_panels
