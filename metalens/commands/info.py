"""What a file is: kind, version, provenance and arrays; masks and networks as well."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro

from metalens.cli import load_above
from metalens.commands.common import MASKS, CommonOptions
from metalens.core import reading, store, transaction
from metalens.core.errors import DAMAGE, StoreError

NETWORK = ".safetensors"
_DRAWINGS = {*MASKS, ".dxf", ".cif"}  # the latter two are refused by name


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens info``.

    Attributes:
        file: an artefact of this toolchain: HDF5, a mask (GDSII or OASIS), a network or
            checkpoint (safetensors), or a folder with a manifest.
        top: cell of a mask to count with all below it; omitted: all top cells.
    """

    file: tyro.conf.Positional[Path]
    top: str | None = None


def run(options: Options) -> int:
    """Print what the file holds; exit 0.

    Args:
        options: of the command line.
    """
    path = options.file
    if path.is_dir():
        values = folder_manifest(path)
        text = _folder_text(values)
    elif path.suffix == NETWORK:
        values = safetensors_head(path)
        lines = _array_lines(values, values["settings"])
        text = "\n".join([f"{values['kind']} version {values['version']}", *lines])
    elif not _DRAWINGS.isdisjoint(suffix.lower() for suffix in path.suffixes):
        masks = load_above("mask")  # also a compressed one (chip.gds.gz)
        values = masks.mask_summary(path, options.top)
        text = masks.mask_summary_text(values)
    else:
        stored = store.load(path)
        values = _stored_values(path.name, stored)
        text = _stored_text(values)
    options.console.result(values, text)
    return 0


def _versions_line(about: dict[str, Any]) -> str:
    return "made with " + ", ".join(f"{k} {v}" for k, v in about["versions"].items())


def _array_lines(values: dict[str, Any], settings: str) -> list[str]:
    arrays = [f"  {name}: {shape}" for name, shape in values["arrays"].items()]
    return [*arrays, *(f"  config: {line}" for line in settings.splitlines() if line)]


def _stored_values(name: str, stored: store.StoredArtefact) -> dict[str, Any]:
    """Content of an HDF5 artefact as a dictionary for JSON."""
    arrays = {name: f"{a.dtype} {tuple(a.shape)}" for name, a in stored.arrays.items()}
    return {
        "file": name,
        "kind": stored.kind,
        "version": stored.version,
        "attributes": stored.attributes,
        "arrays": arrays,
        "provenance": asdict(stored.provenance),
    }


def _stored_text(values: dict[str, Any]) -> str:
    """Kind, version, attributes, provenance and arrays of a file, in words."""
    provenance = values["provenance"]
    attributes = values["attributes"].items()
    return "\n".join(
        [
            f"{values['kind']} version {values['version']}",
            *(f"  {name} = {_short(value)}" for name, value in attributes),
            _versions_line(provenance),
            *(
                f"  from {n} (SHA-256 {h[:16]}…)"
                for n, h in provenance["inputs"].items()
            ),
            *_array_lines(values, provenance["config"]),
        ]
    )


def _short(value: object) -> str:
    """A value on one line of at most 100 characters; floats to 12 digits.

    Rounding to 12 digits drops the errors of arithmetic: 0.94 for 0.9400000000000001.
    """
    text = str(value).strip().replace("\n", "; ")
    if isinstance(value, float):
        text = repr(float(f"{value:.12g}"))
    return text if len(text) <= 100 else text[:97] + "..."


def folder_manifest(path: Path) -> dict[str, Any]:
    """Manifest of a folder, compared with its files.

    Args:
        path: of the folder.

    Raises:
        StoreError: no manifest, unfinished, or a file that is missing or differs.
    """
    manifest = transaction.read_manifest(path)
    if manifest is None:
        raise StoreError(
            f"{path}: no {transaction.NAME} in it, not made by this toolchain; give a file, or a folder of ours"
        )
    transaction.check_manifest(path)
    return {"folder": str(path), **manifest}


def _folder_text(manifest: dict[str, Any]) -> str:
    lines = [
        f"{manifest['folder']}: {len(manifest['files'])} files, each as it was written",
        f"  metalens {manifest['command']}",
    ]
    lines += [
        f"  {name}  {e['bytes']:,} bytes  SHA-256 {e['sha256'][:16]}…"
        for name, e in manifest["files"].items()
    ]
    return "\n".join([*lines, _versions_line(manifest)])


def safetensors_head(path: Path) -> dict[str, Any]:
    """Kind, version, settings and tensors of a safetensors file, by its head.

    Args:
        path: of the file.

    Raises:
        StoreError: missing, cut short, or no such file.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise StoreError(f"{path}: {reading.missing_reason(path)}")
    try:
        with safe_open(path, "numpy") as file:
            about = dict(file.metadata() or {})
            tensors = {name: file.get_slice(name) for name in sorted(file.keys())}
            arrays = {
                name: f"{tensor.get_dtype()} {tuple(tensor.get_shape())}"
                for name, tensor in tensors.items()
            }
        about = dict(json.loads(about["about"])) if "about" in about else about
    except (SafetensorError, RecursionError, *DAMAGE) as error:
        raise StoreError(
            f"{path}: cut short or no safetensors file ({error}); make it again"
        ) from None
    kind = str(about.get("kind", "network"))
    version = str(about.get("version", "1"))
    return {
        "file": path.name,
        "kind": kind,
        "version": version,
        "settings": about.get("settings", ""),
        "arrays": arrays,
    }
