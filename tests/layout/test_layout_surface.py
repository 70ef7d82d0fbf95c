"""The public names of the package, and what they pull in."""

import subprocess
import sys

import pytest

import layout


def test_public_names_are_functions_even_after_their_modules_are_loaded():
    import layout.drc.lattice
    import layout.formats.oasis_write
    import layout.mask.build

    for name in (
        "plan",
        "check_plan",
        "compare",
        "write_oasis",
        "read_oasis",
        "write_gdsii",
        "read_gdsii",
        "write_dxf",
    ):
        assert callable(getattr(layout, name))
        assert name in dir(layout)


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="nonsense"):
        _ = layout.nonsense


def test_making_a_mask_never_loads_torch_nor_the_cad_kernel():
    code = (
        "import numpy as np, layout, sys\nfrom metalens.lens import DiameterMap\n"
        "from layout.process.process import Process\n"
        "plan = layout.plan(DiameterMap(np.full((3, 3), 0.2), 0.4), Process())\n"
        "layout.check_plan(plan, Process().rules)\nprint(' '.join(sys.modules))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"torch", "build123d", "OCP", "matplotlib"} & set(loaded)
