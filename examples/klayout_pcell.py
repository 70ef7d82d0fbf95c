# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A lens as a cell of KLayout and gdsfactory
#
# In KLayout a lens file becomes a parametric cell: its mask is planned for a process, written, and placed like any other cell.
# Run in KLayout's own Python, `LensLibrary()` lists the cell in its library panel. Needs `pip install klayout`.

# %%
import tempfile
from pathlib import Path

import klayout.db as db

import layout
from metalens import design, lens, library
from metalens.design import Focus


class LensCell(db.PCellDeclarationHelper):
    """Parameters: the lens file, and a process file or nothing."""

    def __init__(self):
        super().__init__()
        self.param("lens_file", self.TypeString, "Lens file")
        self.param("process_file", self.TypeString, "Process file", default="")

    def display_text_impl(self):
        return Path(self.lens_file).stem

    def produce_impl(self):
        process = layout.Process()
        if self.process_file:
            process = layout.load_process(self.process_file)
        with tempfile.TemporaryDirectory() as folder:
            mask = Path(folder) / "mask.gds"
            layout.write_gdsii(layout.plan(lens.load(self.lens_file), process), mask)
            drawn = db.Layout()
            drawn.read(str(mask))
        self.cell.copy_tree(drawn.top_cell())


class LensLibrary(db.Library):
    """The library "metalens" of KLayout."""

    def __init__(self):
        super().__init__()
        self.description = "lenses of the metalens toolchain"
        self.layout().register_pcell("Lens", LensCell())
        self.register("metalens")


# %% [markdown]
# Two places for one lens, on a die of its own:

# %%
folder = Path(tempfile.mkdtemp())
focus = Focus(wavelength_um=0.85, sensor_distance_um=40.0, source_distance_um=400.0)
pillars = library.sweep(library.DEFAULT_CELL)
made, _ = design.make(
    design.phase_of(None, focus, radius_um=6.0),
    focus,
    aperture_um=12.0,
    cell=pillars.cell,
    proxy=library.proxy_of(pillars),
)
lens.save(folder / "lens.h5", made)

LensLibrary()
die = db.Layout()
die.dbu = 0.001
top = die.create_cell("DIE")
cell = die.create_cell("Lens", "metalens", {"lens_file": str(folder / "lens.h5")})
for x_um in (-20.0, 20.0):
    top.insert(db.DCellInstArray(cell, db.DTrans(x_um, 0.0)))
shapes = top.begin_shapes_rec(die.layer(1, 0))
drawn = sum(1 for _ in shapes.each())
print(f"{drawn} pillars on layer 1/0, twice {made.diameters.pillars}")

# %% [markdown]
# In [gdsfactory](https://gdsfactory.github.io/gdsfactory/) the written mask is a component:
#
#     lens = gf.import_gds("mask/mask.gds")
#     die = gf.Component()
#     die.add_ref(lens).move((20, 0))
