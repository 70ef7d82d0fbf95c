"""Where the cells of a mask stand that place nothing themselves."""

import numpy as np


def places(library, top):
    """{cell: x and y of all its instances} below a cell."""
    parts = {}
    for name, _, x, y in library.walk(top):
        if name != top and not library.cell(name).children:
            parts.setdefault(name, []).append((x, y))
    return {
        name: tuple(map(np.concatenate, zip(*pairs, strict=True)))
        for name, pairs in parts.items()
    }
