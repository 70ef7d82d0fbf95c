"""Training state on disk, bit for bit, and its JSON log."""

import contextlib
import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from metalens.core import config
from metalens.core.errors import TrainingError
from metalens.core.store import replace_atomically, write_text

VERSION = 12
ABOUT = "about"
_TENSOR = "\0tensor"


def save_checkpoint(
    path: str | Path, state: dict[str, Any], *, settings: object
) -> None:
    """Write a training state.

    Args:
        state: nested dicts and lists of tensors, numbers, strings, booleans and None;
            keys are strings.
        settings: the run's config record; kept as TOML so that a resume can compare it.
        path: of the file.

    Raises:
        OSError: the target cannot be written, the disk is full (the old checkpoint
            stays).
        TrainingError: the state holds something else.
    """
    tensors: dict[str, Tensor] = {}

    def keep_tensor(value: object) -> dict[str, str]:
        if not isinstance(value, Tensor):
            raise TrainingError(
                f"checkpoint entry {value!r} is a {type(value).__name__}; need tensors, numbers, text"
            )
        name = str(len(tensors))
        tensors[name] = value.detach().contiguous().clone()
        return {_TENSOR: name}

    about = {
        "kind": "checkpoint",
        "version": VERSION,
        "state": state,
        "settings": config.dumps(settings),
    }
    content = json.dumps(about, default=keep_tensor)
    with replace_atomically(path) as part:
        try:
            # one entry, since the writer puts several in random order
            save_file(tensors, str(part), metadata={ABOUT: content})
        except SafetensorError as error:
            raise OSError(f"{path}: cannot be written ({error})") from error


def load_checkpoint(path: str | Path, *, settings: object) -> dict[str, Any]:
    """Read a training state back.

    Args:
        path: of the file.

    Raises:
        TrainingError: missing, truncated or foreign file, another version, or a run of
            other settings (the difference is named).
    """
    path = Path(path)
    if not path.is_file():
        raise TrainingError(
            f"{path}: no checkpoint to resume from; start without --resume"
        )
    try:
        with safe_open(str(path), framework="pt") as file:
            about: dict[str, Any] = json.loads(
                (file.metadata() or {}).get(ABOUT, "{}"),
                object_hook=lambda node: (
                    file.get_tensor(node[_TENSOR]) if _TENSOR in node else node
                ),
            )
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise TrainingError(
            f"{path}: truncated or not a checkpoint ({error})"
        ) from error
    kind, version = about.get("kind", "no kind"), about.get("version", "no version")
    if (kind, version) != ("checkpoint", VERSION):
        raise TrainingError(
            f"{path} holds {kind!r} version {version}, need 'checkpoint' version {VERSION}; train again, or go on "
            "with the release that wrote it"
        )
    changed = settings_difference(about["settings"], settings)
    if changed:
        raise TrainingError(
            f"{path} belongs to other settings; start a new run or undo the change:\n{changed}"
        )
    state: dict[str, Any] = about["state"]
    return state


def settings_difference(old: str, settings: object) -> str:
    """Lines ``key: old -> new`` of settings that differ from those in TOML; '' for
    none.
    """
    before, after = _flat_toml(old), _flat_toml(config.dumps(settings))
    return "\n".join(
        f"{k}: {before.get(k, 'absent')} -> {after.get(k, 'absent')}"
        for k in sorted(before.keys() | after.keys())
        if before.get(k) != after.get(k)
    )


def _flat_toml(text: str) -> dict[str, str]:
    """Values of TOML text by ``table.key``, as text."""
    table, result = "", {}
    for line in text.splitlines():
        if line.startswith("["):
            table = line.strip("[]") + "."
        elif " = " in line:
            key, value = line.split(" = ", 1)
            result[table + key] = value
    return result


def append_entry(path: Path, entry: dict[str, Any]) -> None:
    """Add an entry to a log.

    Args:
        path: of the log. entry: of plain values.
    """
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")


def read_entries(path: Path) -> list[dict[str, Any]]:
    """Entries of a log, none without one; a line that a kill cut short is left out.

    Args:
        path: of the log.
    """
    entries = []
    for line in path.read_text("utf-8").splitlines() if path.is_file() else []:
        with contextlib.suppress(json.JSONDecodeError):
            entries.append(json.loads(line))
    return entries


def write_entries(path: Path, entries: list[dict[str, Any]]) -> None:
    """Write a log anew.

    Args:
        path: of the log. entries: that it keeps.
    """
    write_text(path, "".join(json.dumps(entry) + "\n" for entry in entries))
