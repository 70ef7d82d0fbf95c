"""Damaged artefacts: every kind of HDF5 file, truncated or with flipped bits, is
refused by type or read as it was.
"""

import dataclasses
import functools
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from characterize.inference import AsBuilt
from codesign.commands import budget as command_budget
from codesign.evaluate.error_budget import BudgetEntry
from codesign.gaze import shared
from codesign.gaze.shared import MixedModel, PopulationPrior
from metalens import lens, library, psf
from metalens.cell.record import Cell, Index
from metalens.core import store
from metalens.core.errors import MetalensError
from metalens.fabrication import Sensitivity
from metalens.lens.record import DiameterMap, Lens
from metalens.library.record import PillarLibrary, Sweep
from metalens.psf import PsfStack
from tests.proxies import proxy_of

CELL = Cell(pitch_um=0.30, pillar=Index(3.6))
PROXY = proxy_of([8.0, 3.5], [0.9], (0.08, 0.21), 0.85)
RESPONSE = Sensitivity(np.zeros((3, 6)), 0.15)


def _lens():
    diameters = np.linspace(0.08, 0.21, 36, dtype=np.float32).reshape(6, 6)
    return Lens(DiameterMap(diameters, 0.3), CELL, PROXY, 0.85, 2000.0, 20_000.0, "map")


def _library():
    d = np.linspace(0.08, 0.21, 20)
    t = (0.9 * np.exp(55j * d))[None, None, None]
    parts = (
        np.zeros(1),
        np.array([0.85]),
        d,
        t,
        t,
        np.full(t.shape, 1e-4),
        np.ones(t.shape),
        np.zeros((0, 5)),
    )
    return PillarLibrary(CELL, Sweep(), ("x",), *parts, "modal", 20, PROXY)


def _psf():
    axis = (np.array([2e4]), np.zeros((1, 2)), np.array([0.85]), np.ones(1))
    return PsfStack(
        np.full((1, 1, 4, 4), 1 / 16),
        np.ones((1, 1)),
        *axis,
        0.75,
        np.zeros((1, 2)),
        2000.0,
        1e-4,
        1e-5,
        "x",
    )


def _asbuilt():
    one = np.ones(2)
    frames = np.ones((2, 4, 4))
    return AsBuilt(
        design=_lens(), response=RESPONSE, names=("bias_nm", "height_nm"), value=one,
        covariance=np.eye(2), information=np.eye(2),
        fixed={"index": 0.0}, depth_um=one, angle_rad=np.zeros((2, 2)), pixel_um=3.0, measured=frames, predicted=frames,
        nominal=frames, residual_sigma=frames, chi2_per_dof=1.0, converged=True, reason="made up",
    )  # fmt: skip


def _budget_rows():
    return [
        BudgetEntry("mask grid", 0.1, 0.2, 1e-4, "rounded"),
        BudgetEntry("all links", 0.1, math.nan, 1e-3, "sum"),
    ]


def _people():
    rng = np.random.default_rng(0)
    model = MixedModel(
        rng.normal(0, 1, (36, 2)), rng.uniform(0.1, 2, (36, 2)), rng.uniform(0.1, 1, 2)
    )
    return PopulationPrior(model, rng.normal(0, 3, 7), rng.uniform(0.5, 5, 7))


KINDS = {
    "lens": (lambda p: lens.save(p, _lens()), lens.load),
    "library": (lambda p: library.save(p, _library()), library.load),
    "psf": (lambda p: psf.save(p, _psf()), psf.load),
    "asbuilt": (lambda p: _asbuilt().save(p), AsBuilt.load),
    "budget": (
        lambda p: command_budget.save_budget(p, _budget_rows(), store.Provenance()),
        command_budget.load_budget,
    ),
    "people": (lambda p: shared.save_people(p, _people()), shared.load_people),
}


def _same(one, other):
    """Whether two records hold the same numbers, whatever their type."""
    if isinstance(one, np.ndarray):
        return np.array_equal(one, np.asarray(other), equal_nan=one.dtype.kind in "fc")
    if dataclasses.is_dataclass(one):
        names = [f.name for f in dataclasses.fields(one) if f.name != "provenance"]
        return all(_same(getattr(one, n), getattr(other, n)) for n in names)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(
            _same(a, b) for a, b in zip(one, other, strict=True)
        )
    return one == other or str(one) == str(other)


@functools.cache
def written(kind):
    """A file of this kind, whole, and what it holds."""
    write, read = KINDS[kind]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.h5"
        write(path)
        return path.read_bytes(), read(path)


@pytest.mark.parametrize("kind", sorted(KINDS))
@settings(max_examples=20)
@given(data=st.data())
def test_damaged_artefacts_are_refused_or_read_as_they_were(
    tmp_path_factory, kind, data
):
    path = tmp_path_factory.mktemp("fuzz") / "file.h5"
    whole, want = written(kind)
    read, whole = KINDS[kind][1], bytearray(whole)
    if data.draw(st.booleans(), label="truncate"):
        whole = whole[: data.draw(st.integers(0, len(whole) - 1), label="length")]
    else:
        for _ in range(data.draw(st.integers(1, 3), label="flips")):
            at = data.draw(st.integers(0, len(whole) - 1), label="byte")
            whole[at] ^= 1 << data.draw(st.integers(0, 7), label="bit")
    path.write_bytes(bytes(whole))
    found, said = want, str(path)
    try:
        found = read(path)
    except MetalensError as refusal:
        said = str(refusal)
    assert _same(want, found)
    assert str(path) in said


def test_a_number_that_was_edited_is_read_as_it_now_stands(tmp_path):
    import h5py

    lens.save(tmp_path / "l.h5", _lens())
    with h5py.File(tmp_path / "l.h5", "r+") as file:
        file["diameter_um"][2, 3] = 0.1
        file.attrs["wavelength_um"] = 0.86
    edited = lens.load(tmp_path / "l.h5")
    assert edited.diameters.diameter_um[2, 3] == np.float32(0.1)
    assert edited.wavelength_um == 0.86


def test_a_missing_entry_is_named(tmp_path):
    store.save(tmp_path / "l.h5", "lens", {"other": np.ones(3)})
    with pytest.raises(store.StoreError, match="holds no"):
        lens.load(tmp_path / "l.h5")
