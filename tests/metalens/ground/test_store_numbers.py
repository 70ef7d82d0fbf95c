"""How an artefact lies on the disk, by numbers: layouts by their bytes, modes, claims,
journals and defaults.
"""

import importlib.metadata
import os
import stat
import sys
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from metalens.ground import store
from metalens.ground.errors import StoreError


def layout(path, name):
    """(compact, packing, its level, shuffle, checksum, checked) of a data set."""
    with h5py.File(path, "r") as file:
        item = file[name]
        compact = item.id.get_create_plist().get_layout() == h5py.h5d.COMPACT
        return (
            compact,
            item.compression,
            item.compression_opts,
            item.shuffle,
            item.fletcher32,
        )


@pytest.mark.parametrize("compress", [True, False])
def test_arrays_lie_in_the_header_in_chunks_or_packed_by_their_bytes(
    tmp_path, compress
):
    """4096 bytes are the most in a header, 65536 the most that are not packed."""
    counts = {"a": 512, "b": 513, "c": 8192, "d": 8193}  # of 8 bytes
    arrays = {name: np.arange(float(count)) for name, count in counts.items()}
    store.save(
        tmp_path / "x.h5", "lens", arrays, **({} if compress else {"compress": False})
    )
    assert layout(tmp_path / "x.h5", "a") == (True, None, None, False, False)
    for name in "bc":
        assert layout(tmp_path / "x.h5", name) == (False, None, None, False, True)
    packed = ("gzip", 1, True) if compress else (None, None, False)
    assert layout(tmp_path / "x.h5", "d") == (False, *packed, True)
    back = store.load(tmp_path / "x.h5", "lens")
    assert all(
        np.array_equal(back.arrays[name], array) for name, array in arrays.items()
    )


def test_a_plain_artefact_has_version_1_and_no_seed(tmp_path):
    store.save(tmp_path / "x.h5", "lens", {})
    back = store.load(tmp_path / "x.h5", "lens")
    assert (back.version, back.provenance.seed) == (1, -1)
    store.save(
        tmp_path / "y.h5",
        "lens",
        {},
        version=3,
        provenance=store.Provenance("a = 1", {"in": "12"}, 7, {"p": "2"}),
    )
    back = store.load(tmp_path / "y.h5", "lens", version=3)
    assert back.version == 3
    assert back.provenance == store.Provenance("a = 1", {"in": "12"}, 7, {"p": "2"})
    with pytest.raises(StoreError, match="version 3, need 'lens' version 1"):
        store.load(tmp_path / "y.h5", "lens")


def test_versions_are_of_python_by_three_numbers_and_of_the_packages():
    found = dict(store.package_versions())
    assert (
        found["python"]
        == f"{sys.version_info.major}.{sys.version_info.minor}.{sys.version_info.micro}"
    )
    assert found["numpy"] == importlib.metadata.version("numpy")


@pytest.mark.parametrize(
    ("mask", "mode"), [(0o022, 0o644), (0o027, 0o640), (0o000, 0o666)]
)
def test_files_have_the_mode_of_any_new_file_and_the_mask_stays(tmp_path, mask, mode):
    before = os.umask(mask)
    try:
        store.write_text(tmp_path / "a.txt", "x")
        assert os.umask(mask) == mask
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == mode


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", "né\n"),
        ("ab\n", "ab\nné\n"),
        ("ab\ncd", "ab\nné\n"),
        ("abc", "né\n"),
        ("ab\nc", "ab\nné\n"),
        ("\n", "\nné\n"),
        ("ab\n\ncd\n", "ab\n\ncd\nné\n"),
    ],
)
def test_a_line_is_added_after_the_last_whole_one(tmp_path, before, after):
    (tmp_path / "j").write_text(before)
    assert store.whole_lines(tmp_path / "j") == before.split("\n")[:-1]
    store.append_line(tmp_path / "j", "né")
    assert (tmp_path / "j").read_text(encoding="utf-8") == after
    assert store.whole_lines(tmp_path / "none") == []


def test_scratch_of_this_name_alone_goes(tmp_path):
    names = [".a.h5.1.part", ".a.h5.1.tmp", ".b.h5.1.part", "a.h5.part"]
    for name in names:
        (tmp_path / name).touch()
    store.clear(tmp_path / "a.h5")
    assert sorted(os.listdir(tmp_path)) == sorted(names[1:])


def claim(nbytes, stored):
    item = SimpleNamespace(shape=(3,), is_virtual=False, external=None, nbytes=nbytes)
    item.id = SimpleNamespace(get_storage_size=lambda: stored)
    return item


@pytest.mark.parametrize(("stored", "most"), [(0, 4096), (10, 10 * 1040 + 4096)])
def test_values_claim_no_more_than_their_bytes_can_hold(tmp_path, stored, most):
    store.check_claim(tmp_path, claim(most, stored), "x")
    with pytest.raises(StoreError, match="damaged"):
        store.check_claim(tmp_path, claim(most + 1, stored), "x")


@pytest.mark.parametrize(("more", "refused"), [(0, False), (1, True)])
def test_all_arrays_together_take_64_gibibytes_at_most(
    tmp_path, monkeypatch, more, refused
):
    items = [claim(1 << 35, 1 << 35), claim((1 << 35) + more, 1 << 35)]
    monkeypatch.setattr(store.h5py, "Dataset", SimpleNamespace)
    file = SimpleNamespace(
        visititems=lambda see: [see(f"a{n}", item) for n, item in enumerate(items)]
    )
    if refused:
        with pytest.raises(StoreError, match=r"take 68\.7 GB"):
            store._listed(tmp_path, file)
    else:
        assert [name for name, _ in store._listed(tmp_path, file)] == ["a0", "a1"]


def test_texts_are_kept_at_their_own_length_and_empty_ones_too(tmp_path):
    texts = np.array([["né", ""], ["longer", "x"]])
    store.save(
        tmp_path / "x.h5",
        "lens",
        {"t": texts, "none": np.array([""])},
        attributes={"empty": "", "name": "né"},
    )
    with h5py.File(tmp_path / "x.h5", "r") as file:
        assert file["t"].dtype.itemsize == 6
        assert file["none"].dtype.itemsize == 1
        assert file.attrs.get_id("name").dtype.itemsize == 3  # bytes of UTF-8
        assert file.attrs.get_id("empty").dtype.itemsize == 1
    back = store.load(tmp_path / "x.h5", "lens")
    assert [
        [value.decode() for value in row] for row in back.arrays["t"]
    ] == texts.tolist()
    assert (back.attributes["empty"], back.attributes["name"]) == ("", "né")
    assert store.kind_of(tmp_path / "x.h5") == "lens"


def test_the_kind_of_another_programs_file_is_not_told(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.attrs.update(kind="lens", units="mm")
    assert store.kind_of(tmp_path / "x.h5") == ""
