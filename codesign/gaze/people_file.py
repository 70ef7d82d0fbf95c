"""The mixed-effects gaze model of a population as a file, by which a device calibrates
its wearer.
"""

from pathlib import Path

import numpy as np

from codesign.gaze.shared import MixedModel, PopulationPrior
from metalens.core import store
from metalens.core.errors import StoreError
from metalens.core.store import typed_reader

KIND = "people"
SHAPES = {
    "mean": (36, 2),
    "variance": (36, 2),
    "noise": (2,),
    "middle": (7,),
    "spread": (7,),
}


def save_people(
    path: Path, people: PopulationPrior, *, provenance: store.Provenance | None = None
) -> None:
    """Write a file of kind ``people``: β, τ² and σ² in deg and deg², middle and spread
    of the readings in deg and mm.

    Args:
        path: of the file. provenance: of the file.

    Raises:
        OSError: the target cannot be written (the old file stays).
    """
    model = people.model
    arrays = {"mean": model.mean, "variance": model.variance, "noise": model.noise}
    store.save(
        path,
        KIND,
        arrays | {"middle": people.middle, "spread": people.spread},
        provenance=provenance,
    )


@typed_reader
def load_people(path: Path) -> PopulationPrior:
    """Read a file of kind ``people``.

    Args:
        path: of the file.

    Raises:
        StoreError: no such file, another kind, or entries that no people can have.
    """
    arrays = store.load(path, KIND).arrays
    found = {name: np.asarray(arrays[name], dtype=float) for name in SHAPES}
    odd = [
        name
        for name, shape in SHAPES.items()
        if found[name].shape != shape
        or not np.isfinite(found[name]).all()
        or (name in ("variance", "noise", "spread") and found[name].min() <= 0)
    ]
    if odd:
        raise StoreError(
            f"{path}: {', '.join(odd)} of a shape or value that no people have; edited: make it again"
        )
    *model, middle, spread = found.values()
    return PopulationPrior(MixedModel(*model), middle, spread)
