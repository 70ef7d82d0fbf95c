"""What a file is: kind, version, provenance, arrays and a small picture of the largest;
masks and networks as well.
"""

import importlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from metalens.commands.common import MASKS, CommonOptions
from metalens.core import store, transaction
from metalens.core.arrays import Array
from metalens.core.errors import StoreError

_SHADES = " .:-=+*#%@"
NETWORK = ".safetensors"
_DRAWINGS = {*MASKS, ".dxf", ".cif"}  # the latter two are refused by name
_HDF5 = b"\x89HDF"  # first bytes
# kind of file: module of a package above with ``told`` and ``text``, filled by the
# command line
TOLD: dict[str, str] = {}


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens info``.

    Attributes:
        file: an artefact of this toolchain: HDF5, a mask (GDSII or OASIS), a network or
            checkpoint (safetensors), a
            folder with a manifest, or any file of one.
        top: cell of a mask to count with all below it; omitted: all top cells.
    """

    file: tyro.conf.Positional[Path]
    top: str | None = None


def run(options: Options) -> int:
    """Print what the file holds; exit 0.

    Args:
        options: of the command line.
    """
    if options.file.is_dir():
        told = folder_manifest(options.file)
        options.console.result(told, _folder_text(told))
        return 0
    if options.file.suffix == NETWORK:
        told = safetensors_head(options.file)
        options.console.result(told, _network_text(told))
        return 0
    if _is_drawing(options.file) and "mask" in TOLD:
        module = importlib.import_module(TOLD["mask"])
        told = module.mask_summary(options.file, options.top)
        options.console.result(told, module.mask_summary_text(told))
        return 0
    if (listed := manifest_entry(options.file)) is not None:
        options.console.result(listed, _member_text(listed))
        return 0
    stored = store.load(options.file)
    about = _about(options.file.name, stored)
    options.console.result(about, _text(stored, about["arrays"]))
    return 0


def _is_drawing(path: Path) -> bool:
    """Whether a file is named as a mask, also a compressed one (chip.gds.gz)."""
    return not _DRAWINGS.isdisjoint(suffix.lower() for suffix in path.suffixes)


def _about(name: str, stored: store.StoredArtefact) -> dict[str, Any]:
    arrays = {name: f"{a.dtype} {tuple(a.shape)}" for name, a in stored.arrays.items()}
    return {
        "file": name,
        "kind": stored.kind,
        "version": stored.version,
        "attributes": stored.attributes,
        "arrays": arrays,
        "provenance": {
            "config": stored.provenance.config,
            "inputs": dict(stored.provenance.inputs),
            "seed": stored.provenance.seed,
            "versions": dict(stored.provenance.versions),
        },
    }


def manifest_entry(path: Path) -> dict[str, Any] | None:
    """A file that is no HDF5, as the manifest of its folder lists it: command and
    versions; None where none does.

    Args:
        path: file to read or write.

    Raises:
        StoreError: it is not as it was written.
    """
    found = transaction.read_manifest(path.parent) if path.is_file() else None
    listed = (found or {}).get("files", {}).get(path.name)
    if found is None or listed is None:
        return None
    with open(path, "rb") as file:
        if file.read(len(_HDF5)) == _HDF5:
            return None
    if store.sha256(path) != listed["sha256"]:
        raise StoreError(
            f"{path}: not as `metalens {found['command']}` wrote it; make it again"
        )
    return {
        "file": path.name,
        "command": found["command"],
        "versions": found["versions"],
        **listed,
    }


def _member_text(told: dict[str, Any]) -> str:
    versions = ", ".join(f"{k} {v}" for k, v in told["versions"].items())
    first = f"{told['file']}: {told['bytes']:,} bytes, as it was written by\n  metalens {told['command']}"
    return f"{first}\nmade with {versions}"


def folder_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a folder, after its files were compared with it.

    Args:
        path: file to read or write.

    Raises:
        StoreError: no manifest, unfinished, or a file that is missing or differs.
    """
    found = transaction.read_manifest(path)
    if found is None:
        raise StoreError(
            f"{path}: no {transaction.NAME} in it, not made by this toolchain; give a file, or a folder of ours"
        )
    transaction.check_manifest(path)
    return {"folder": str(path), **found}


def _folder_text(told: dict[str, Any]) -> str:
    lines = [
        f"{told['folder']}: {len(told['files'])} files, each as it was written",
        f"  metalens {told['command']}",
    ]
    lines += [
        f"  {name}  {e['bytes']:,} bytes  SHA-256 {e['sha256'][:16]}…"
        for name, e in told["files"].items()
    ]
    return "\n".join(
        [
            *lines,
            "made with " + ", ".join(f"{k} {v}" for k, v in told["versions"].items()),
        ]
    )


def safetensors_head(path: Path) -> dict[str, Any]:
    """Kind, version, settings and tensors in the head of a safetensors file (8 bytes of
    its length, then JSON).

    Args:
        path: file to read or write.

    Raises:
        StoreError: missing, cut short, or no such file.
    """
    try:
        with open(path, "rb") as file:
            length = int.from_bytes(file.read(8), "little")
            size = path.stat().st_size
            head = json.loads(file.read(length) if length <= size else b"")
        tensors = {
            name: entry for name, entry in head.items() if name != "__metadata__"
        }
        about = dict(head.get("__metadata__", {}))
        if "about" in about:
            about = {
                k: v for k, v in json.loads(about["about"]).items() if k != "state"
            }
        ends = [int(entry["data_offsets"][1]) for entry in tensors.values()]
        arrays = {
            name: f"{entry['dtype']} {tuple(entry['shape'])}"
            for name, entry in sorted(tensors.items())
        }
    except FileNotFoundError:
        raise StoreError(f"{path}: no such file") from None
    except (
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        OverflowError,
        RecursionError,
    ) as error:
        raise StoreError(
            f"{path}: cut short or no safetensors file ({error}); make it again"
        ) from None
    if 8 + length + max(ends, default=0) != size:
        raise StoreError(
            f"{path}: {size} bytes, need {8 + length + max(ends, default=0)}: cut short; make it again"
        )
    kind, version = str(about.get("kind", "network")), str(about.get("version", "1"))
    return {
        "file": path.name,
        "kind": kind,
        "version": version,
        "settings": about.get("settings", ""),
        "arrays": arrays,
    }


def _network_text(told: dict[str, Any]) -> str:
    lines = [f"{told['kind']} version {told['version']}"]
    lines += [f"  {name}: {shape}" for name, shape in told["arrays"].items()]
    return "\n".join(
        [
            *lines,
            *("  config: " + line for line in told["settings"].splitlines() if line),
        ]
    )


def _text(stored: store.StoredArtefact, arrays: dict[str, str]) -> str:
    made = stored.provenance
    lines = [f"{stored.kind} version {stored.version}"]
    lines += [
        f"  {name} = {_short(value)}" for name, value in stored.attributes.items()
    ]
    lines += [f"  {name}: {shape}" for name, shape in arrays.items()]
    lines.append("made with " + ", ".join(f"{k} {v}" for k, v in made.versions.items()))
    lines += [
        f"  from {name} (SHA-256 {digest[:16]}…)"
        for name, digest in made.inputs.items()
    ]
    lines += ["  config: " + line for line in made.config.splitlines() if line]
    picture = max(
        stored.arrays.values(), key=lambda a: a.size if a.ndim >= 2 else 0, default=None
    )
    if picture is not None and picture.ndim >= 2 and picture.dtype.kind in "fiu":
        lines += text_sketch(picture)
    return "\n".join(lines)


def _short(value: object) -> str:
    """One line; of a float the digits that arithmetic leaves right: 0.94 for
    0.9400000000000001.
    """
    text = (
        repr(float(f"{value:.12g}"))
        if isinstance(value, float)
        else str(value).strip().replace("\n", "; ")
    )
    return text if len(text) <= 100 else text[:97] + "..."


def text_sketch(array: Array, *, columns: int = 48) -> list[str]:
    """Lines of characters that show a (…, y, x) array, its first image, darkest for the
    largest value.

    Args:
        columns: panels or characters along a row.
    """
    image = np.asarray(array.reshape(-1, *array.shape[-2:])[0], float)
    rows = max(1, round(columns * image.shape[0] / image.shape[1] / 2))
    picked = image[
        np.ix_(_spread(image.shape[0], rows), _spread(image.shape[1], columns))
    ]
    low, high = float(np.nanmin(picked)), float(np.nanmax(picked))
    level = np.nan_to_num((picked - low) / (high - low or 1.0)) * (len(_SHADES) - 1)
    return ["".join(_SHADES[int(v)] for v in row) for row in level]


def _spread(length: int, count: int) -> Array:
    return np.linspace(0, length - 1, min(length, count)).astype(int)
