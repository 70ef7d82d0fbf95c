"""What a file is: kind, version, provenance, its arrays, and a small picture of the largest."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from metalens import store
from metalens.commands import Common

_SHADES = " .:-=+*#%@"


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens info``.

    Attributes:
        file: an artefact of this toolchain.
    """

    file: tyro.conf.Positional[Path]


def run(options: Options) -> int:
    """Print what the file holds; exit 0."""
    stored = store.load(options.file)
    arrays = {name: f"{a.dtype} {tuple(a.shape)}" for name, a in stored.arrays.items()}
    about = {
        "file": options.file.name,
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
    options.console.result(about, _text(stored, arrays))
    return 0


def _text(stored: store.Stored, arrays: dict[str, str]) -> str:
    made = stored.provenance
    lines = [f"{stored.kind} version {stored.version}"]
    lines += [f"  {name} = {_short(value)}" for name, value in stored.attributes.items()]
    lines += [f"  {name}: {shape}" for name, shape in arrays.items()]
    lines.append("made with " + ", ".join(f"{k} {v}" for k, v in made.versions.items()))
    lines += [f"  from {name} (SHA-256 {digest[:16]}…)" for name, digest in made.inputs.items()]
    lines += ["  config: " + line for line in made.config.splitlines() if line]
    picture = max(stored.arrays.values(), key=lambda a: a.size if a.ndim >= 2 else 0, default=None)
    if picture is not None and picture.ndim >= 2 and picture.dtype.kind in "fiu":
        lines += sketch(picture)
    return "\n".join(lines)


def _short(value: object) -> str:
    text = str(value).strip().replace("\n", "; ")
    return text if len(text) <= 100 else text[:97] + "..."


def sketch(array: store.Array, *, columns: int = 48) -> list[str]:
    """Lines of characters that show a (…, y, x) array, its first image, darkest for the largest value."""
    image = np.asarray(array.reshape(-1, *array.shape[-2:])[0], float)
    rows = max(1, round(columns * image.shape[0] / image.shape[1] / 2))
    picked = image[np.ix_(_spread(image.shape[0], rows), _spread(image.shape[1], columns))]
    low, high = float(np.nanmin(picked)), float(np.nanmax(picked))
    level = np.nan_to_num((picked - low) / (high - low or 1.0)) * (len(_SHADES) - 1)
    return ["".join(_SHADES[int(v)] for v in row) for row in level]


def _spread(length: int, count: int) -> store.Array:
    return np.linspace(0, length - 1, min(length, count)).astype(int)
