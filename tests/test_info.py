"""``metalens info`` on every kind of artefact that the toolchain writes, whole and cut
short.
"""

import ast
import functools
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from codesign.train import checkpoint
from codesign.train.trainer import InnerConfig
from metalens.cli import BAD_INPUT, SUCCESS
from metalens.core import store
from tests.command_line import call
from tests.fuzz import test_file_fuzz as artefacts

ROOT = Path(__file__).parents[1]
SAVES = ("store.save", "store.save_record")
PACKAGES = ("metalens", "layout", "characterize", "codesign")


@functools.cache
def _kinds():
    """Second argument of every call that saves an artefact, in the packages."""
    texts = [
        path.read_text(encoding="utf-8")
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
    ]
    calls = [
        node
        for text in texts
        if any(name in text for name in SAVES)
        for node in ast.walk(ast.parse(text))
    ]
    calls = [
        node
        for node in calls
        if isinstance(node, ast.Call) and ast.unparse(node.func) in SAVES
    ]
    return {
        node.args[1].value for node in calls if isinstance(node.args[1], ast.Constant)
    }


def _write(kind, path):
    if kind in artefacts.KINDS:
        artefacts.KINDS[kind][0](path)
    else:  # info asks no more of a kind than that it was written by the store
        store.save(
            path,
            kind,
            {"image": np.eye(12)},
            provenance=store.Provenance(config="x = 1\n", seed=3),
        )


@pytest.mark.parametrize("kind", sorted(_kinds()))
def test_every_kind_of_file_says_what_it_is_and_what_made_it(kind, tmp_path, capsys):
    path = tmp_path / "f.h5"
    _write(kind, path)
    assert call(f"info {path} --json") == SUCCESS
    told = json.loads(capsys.readouterr().out)
    assert (told["kind"], told["version"]) == (kind, 1)
    assert told["arrays"]
    assert "metalens-toolchain" in told["provenance"]["versions"]
    path.write_bytes(path.read_bytes()[:-9])
    assert call(f"info {path}") == BAD_INPUT
    assert str(path) in capsys.readouterr().err


def test_checkpoints_and_networks_are_told_by_their_heads(tmp_path, capsys):
    path = tmp_path / "checkpoint.safetensors"
    checkpoint.save_checkpoint(
        path,
        {"net": {"w": torch.ones(3, 2)}, "counters": [1, 0, 0]},
        settings=InnerConfig(steps=7),
    )
    assert call(f"info {path}") == SUCCESS
    text = capsys.readouterr().out
    assert text.startswith(f"checkpoint version {checkpoint.VERSION}")
    assert "F32 (3, 2)" in text
    assert "config: steps = 7" in text
    whole = path.read_bytes()
    for damaged in (
        whole[:5],
        whole[:40],
        whole[:-1],
        b"",
        b"\xff" * 30,
        (2).to_bytes(8, "little") + b"[]",
    ):
        path.write_bytes(damaged)
        assert call(f"info {path}") == BAD_INPUT
        assert "make it again" in capsys.readouterr().err
    assert call(f"info {tmp_path}/absent.safetensors") == BAD_INPUT
