"""Artefact files: whole or not at all, same input same bytes, refused by name when
foreign.
"""

import tracemalloc

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from metalens.core import store
from metalens.core.errors import StoreError

ARRAYS = {
    "a": np.arange(6.0).reshape(2, 3),
    "group/b": np.arange(40_000),
    "names": np.array(["x", "µm"]),
}


def test_round_trip_keeps_arrays_attributes_and_provenance(tmp_path):
    made = store.Provenance(config="x = 1\n", inputs={"cell.toml": "ab" * 32}, seed=7)
    store.save(
        tmp_path / "f.h5",
        "lens",
        ARRAYS,
        attributes={"pitch_um": 0.4, "n": 3},
        provenance=made,
    )
    back = store.load(tmp_path / "f.h5", "lens")
    np.testing.assert_array_equal(back.arrays["a"], ARRAYS["a"])
    np.testing.assert_array_equal(back.arrays["group/b"], ARRAYS["group/b"])
    assert [n.decode() for n in back.arrays["names"]] == ["x", "µm"]
    assert back.attributes == {"pitch_um": 0.4, "n": 3}
    assert (
        back.provenance.config,
        dict(back.provenance.inputs),
        back.provenance.seed,
    ) == (made.config, dict(made.inputs), 7)
    assert back.provenance.versions["numpy"] == np.__version__


@settings(max_examples=25)
@given(
    hnp.arrays(
        st.sampled_from([np.float32, np.int64, np.complex128]),
        hnp.array_shapes(min_dims=0, max_dims=3),
    )
)
def test_any_array_comes_back_bit_for_bit(tmp_path_factory, array):
    path = tmp_path_factory.mktemp("s") / "f.h5"
    store.save(path, "psf", {"x": array})
    back = store.load(path, "psf").arrays["x"]
    assert back.dtype == array.dtype
    assert back.tobytes() == array.tobytes()


def test_same_input_gives_the_same_bytes(tmp_path):
    for name in ("one", "two"):
        store.save(tmp_path / name, "lens", ARRAYS, attributes={"b": 1.0, "a": 2.0})
    assert store.sha256(tmp_path / "one") == store.sha256(tmp_path / "two")


def test_foreign_hdf5_is_refused(tmp_path):
    with h5py.File(tmp_path / "f.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(StoreError, match="not made by this toolchain"):
        store.load(tmp_path / "f.h5")


def test_unwritable_target_is_an_oserror(tmp_path):
    with pytest.raises(OSError, match="absent"):
        store.save(tmp_path / "absent" / "f.h5", "lens", ARRAYS)


def test_a_file_is_written_without_a_second_copy_in_memory(tmp_path):
    """Chunks are at most 1 MiB, and the library holds a few of them; a whole image
    would be 24 MB.
    """
    light = np.random.default_rng(7).random(3 * 10**6)
    tracemalloc.start()
    store.save(tmp_path / "f.h5", "lens", {"light": light}, compress=False)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 6 << 20
    np.testing.assert_array_equal(
        store.load(tmp_path / "f.h5", "lens").arrays["light"], light
    )


def test_a_journal_s_last_line_counts_where_it_is_whole(tmp_path):
    path = tmp_path / "log"
    assert store.whole_lines(path) == []
    path.write_text("one\ntwo\nthr")
    assert store.whole_lines(path) == ["one", "two"]
    store.append_line(path, "four")
    assert store.whole_lines(path) == ["one", "two", "four"]


def test_what_is_no_artefact_is_named_as_what_it_is(tmp_path):
    np.save(tmp_path / "phase.npy", np.eye(3))
    with pytest.raises(
        StoreError, match=r"phase\.npy: an array of NumPy, need an HDF5 file"
    ):
        store.load(tmp_path / "phase.npy")


def test_an_array_without_a_shape_is_refused(tmp_path):
    """HDF5 knows entries of no values at all; of two damaged files in 1450 that
    `metalens info` was given.
    """
    store.save(tmp_path / "a.h5", "lens", {"x": np.ones(3)})
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["y"] = h5py.Empty("f8")
    with pytest.raises(StoreError, match=r"a\.h5: 'y' is empty, without even a shape"):
        store.load(tmp_path / "a.h5")
