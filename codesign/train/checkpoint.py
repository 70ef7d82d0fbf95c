"""Training state on disk, bit for bit, and the JSON log beside it."""

import contextlib
import json
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from metalens.core import config
from metalens.core.errors import TrainingError
from metalens.core.store import replace_atomically, write_text

VERSION = 10
ABOUT = "about"
_TENSOR = "\0tensor"


def save(path: str | Path, state: dict[str, Any], *, settings: object) -> None:
    """Write a training state.

    Args:
        state: nested dicts and lists of tensors, numbers, strings, booleans and None;
            keys are strings or integers.
        settings: the run's config record; kept as TOML so that a resume can compare it.
        path: of the file.

    Raises:
        OSError: the target cannot be written, the disk is full (the old checkpoint
            stays).
        TrainingError: the state holds something else.
    """
    tensors: dict[str, Tensor] = {}
    tree = _separate_tensors(state, "", tensors)
    about = {
        "kind": "checkpoint",
        "version": VERSION,
        "state": tree,
        "settings": config.dumps(settings),
    }
    _write(Path(path), tensors, ABOUT, json.dumps(about))


def save_network(
    path: str | Path, net: nn.Module, *, beside: Mapping[str, Tensor] | None = None
) -> None:
    """Write the weights of a network, and the tensors ``beside``, to a file.

    The same weights give the same bytes.

    Args:
        path: of the file. net: network. beside: further tensors by name.

    Raises:
        OSError: the target cannot be written, the disk is full (the old file stays).
    """
    _write(
        Path(path),
        {
            name: tensor.detach().contiguous()
            for name, tensor in {**net.state_dict(), **(beside or {})}.items()
        },
        "kind",
        "subnet",
    )


def load_network(path: str | Path) -> dict[str, Tensor]:
    """Weights by name of :func:`save_network`.

    Args:
        path: of the file.

    Raises:
        TrainingError: no such file, or not a network.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            if (file.metadata() or {}).get("kind") != "subnet":
                raise TrainingError(f"{path}: not the weights of a run's network")
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError) as error:
        raise TrainingError(
            f"{path}: missing, truncated or no network ({error}); finish the run again"
        ) from error


def _write(path: Path, tensors: dict[str, Tensor], key: str, value: str) -> None:
    """Write tensors and one metadata entry to a safetensors file, atomically.

    One entry, since the writer puts several in random order.
    """
    with replace_atomically(path) as part:
        try:
            save_file(tensors, str(part), metadata={key: value})
        except SafetensorError as error:
            raise OSError(f"{path}: cannot be written ({error})") from error


def load(path: str | Path, *, settings: object) -> dict[str, Any]:
    """Read a training state back.

    Args:
        path: of the file.

    Raises:
        TrainingError: missing, truncated or foreign file, another version, or a run of
            other settings (the
            difference is named).
    """
    path = Path(path)
    if not path.is_file():
        raise TrainingError(
            f"{path}: no checkpoint to resume from; start without --resume"
        )
    try:
        with safe_open(str(path), framework="pt") as file:
            about = _about(file.metadata() or {})
            _check(path, about, settings)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        merged: dict[str, Any] = _insert_tensors(about["state"], tensors)
    except TrainingError:
        raise
    except (
        SafetensorError,
        OSError,
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        RecursionError,
    ) as error:
        raise TrainingError(
            f"{path}: truncated or not a checkpoint ({error})"
        ) from error
    return merged


def settings_difference(old: str, settings: object) -> str:
    """Lines ``key: old -> new`` of settings that differ from those in TOML; '' for
    none.

    A setting that the old ones lack is taken at its present default. One whose default
    changes behaviour needs another :data:`VERSION`.
    """
    before = _flat_toml(old)
    after = _flat_toml(config.dumps(settings))
    defaults = _flat_toml(config.dumps(_with_defaults(settings)))
    before = {key: value for key, value in defaults.items() if key in after} | before
    keys = sorted(before.keys() | after.keys())
    changed = [k for k in keys if before.get(k) != after.get(k)]
    return "\n".join(
        f"{k}: {before.get(k, 'absent')} -> {after.get(k, 'absent')}" for k in changed
    )


def _with_defaults(settings: Any) -> Any:
    """Settings of the same kind, with every field that has a default at it."""
    values: dict[str, Any] = {}
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            values[field.name] = _with_defaults(value)
        elif field.default is MISSING and field.default_factory is MISSING:
            values[field.name] = value
    return type(settings)(**values)


def _about(metadata: dict[str, str]) -> dict[str, Any]:
    try:
        about: dict[str, Any] = json.loads(metadata.get(ABOUT, "{}"))
    except json.JSONDecodeError:
        return {}
    return about


def _check(path: Path, metadata: dict[str, Any], settings: object) -> None:
    """Refuse a file of another kind or version, or of other settings.

    Raises:
        TrainingError: with the difference.
    """
    if metadata.get("kind") != "checkpoint" or metadata.get("version") != VERSION:
        found = metadata.get("kind", "no kind"), metadata.get("version", "no version")
        raise TrainingError(
            f"{path} holds {found[0]!r} version {found[1]}, need 'checkpoint' version {VERSION}; train again, or go on "
            "with the release that wrote it"
        )
    changed = settings_difference(metadata["settings"], settings)
    if changed:
        raise TrainingError(
            f"{path} belongs to other settings; start a new run or undo the change:\n{changed}"
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


def _separate_tensors(node: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    """JSON tree of a state, with tensors replaced by names and put into ``tensors``.

    Raises:
        TrainingError: neither a container, a tensor nor a plain value.
    """
    if isinstance(node, Tensor):
        tensors[name] = node.detach().contiguous().clone()
        return {_TENSOR: name}
    if isinstance(node, dict):
        return {
            "items": [
                [k, _separate_tensors(v, f"{name}/{k}", tensors)]
                for k, v in node.items()
            ]
        }
    if isinstance(node, list | tuple):
        return [
            _separate_tensors(v, f"{name}/{i}", tensors) for i, v in enumerate(node)
        ]
    if node is None or isinstance(node, bool | int | float | str):
        return node
    raise TrainingError(
        f"checkpoint entry {name or '/'} is a {type(node).__name__}; need tensors, numbers, text"
    )


def _insert_tensors(tree: Any, tensors: dict[str, Tensor]) -> Any:
    """The state of a JSON tree of :func:`_separate_tensors` and its tensors."""
    if isinstance(tree, list):
        return [_insert_tensors(v, tensors) for v in tree]
    if isinstance(tree, dict):
        if _TENSOR in tree:
            return tensors[tree[_TENSOR]]
        return {k: _insert_tensors(v, tensors) for k, v in tree["items"]}
    return tree


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
