"""A file is read through at both ends of every data set before anybody trusts it."""

import h5py
import numpy as np

from metalens.ground import reading


def test_the_first_and_the_last_entry_of_every_data_set_are_read(tmp_path, monkeypatch):
    """What is damaged at the end of a file lies in the last block of its last data set."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["line"] = np.arange(7.0)
        file["more/box"] = np.arange(60.0).reshape(3, 4, 5)
        file["more/nothing"] = np.empty((0, 3))
    read, plain = {}, h5py.Dataset.__getitem__

    def asked(item, at):
        value = plain(item, at)
        read.setdefault(item.name, set()).add(float(value))
        return value

    with h5py.File(tmp_path / "a.h5", "r") as file:
        monkeypatch.setattr(h5py.Dataset, "__getitem__", asked)
        reading.read_through(file)
    assert read == {"/line": {0.0, 6.0}, "/more/box": {0.0, 59.0}}
