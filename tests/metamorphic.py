"""Symmetries that results of the public verbs must have, by name of verb and symmetry.

Every entry draws its own case and returns pairs (one result, the other, error bar).
"""

import dataclasses
import math

import numpy as np
import torch

import layout
from metalens import cell as cells
from metalens import design, lens, library, modal, propagate, proxy, psf, rcwa

ENGINES = {"rcwa": rcwa.solve, "modal": modal.solve}
LINEAR = proxy.Proxy(
    np.array([[0.0, 3 * math.pi]]),
    np.array([[0.94]]),
    (0.08, 0.32),
    (0.85, 0.85),
    1e-6,
    1e-6,
)  # phase grows with the diameter alone: design and mask need no solver here


# one pillar cell -----------------------------------------------------------------


def pillar(rng, **more):
    """A lossless subwavelength cell, its diameter and wavelength."""
    index = cells.Index
    one = cells.Cell(
        pitch_um=rng.uniform(0.3, 0.36),
        height_um=rng.uniform(0.3, 0.6),
        pillar=index(rng.uniform(2.0, 2.6)),
        substrate=index(rng.uniform(1.4, 1.5)),
        between=index(1.0),
        under=(cells.Film(index(1.9), rng.uniform(0.03, 0.08)),),
    )
    return dataclasses.replace(one, **more), one.pitch_um * rng.uniform(0.4, 0.7), 0.85


def compare(one, other):
    """Two responses agree within their own error bars, and to rounding beyond."""
    bar = one.t_error + other.t_error + 1e-9
    return [(one.t, other.t, bar), (one.energy, other.energy, 1e-8)]


def cell_energy(solve, rng):
    cell, d, wave = pillar(rng)
    return [(solve(cell, d, wave, tolerance=3e-3).energy, 1.0, 1e-8)]


def cell_scale(solve, rng):
    cell, d, wave = pillar(rng)
    s = rng.uniform(0.5, 2.0)
    larger = dataclasses.replace(
        cell,
        pitch_um=s * cell.pitch_um,
        height_um=s * cell.height_um,
        under=(cells.Film(cell.under[0].material, s * cell.under[0].thickness_um),),
    )
    one = solve(cell, d, wave, tolerance=3e-3)
    return compare(one, solve(larger, s * d, s * wave, tolerance=3e-3))


def cell_reciprocity(solve, rng):
    cell, d, wave = pillar(rng)
    turned = dataclasses.replace(
        cell,
        substrate=cell.cover,
        cover=cell.substrate,
        between=cell.fill,
        under=(),
        over=cell.under,
    )
    one = solve(cell, d, wave, tolerance=3e-3)
    other = solve(turned, d, wave, tolerance=3e-3)
    return [(one.t, other.t, one.t_error + other.t_error + 1e-9)]


def cell_mirror(solve, rng):
    cell, d, wave = pillar(rng)
    angle = rng.uniform(0.05, 0.25)
    sides = [
        solve(cell, d, wave, angle_rad=a, polarization="s", tolerance=5e-3)
        for a in (angle, -angle)
    ]
    return compare(*sides)


def cell_quarter_turn(solve, rng):
    cell, d, wave = pillar(rng)
    angle = rng.uniform(0.05, 0.25)
    how = {"angle_rad": angle, "polarization": "p", "tolerance": 5e-3}
    one = solve(cell, d, wave, **how)
    return compare(one, solve(cell, d, wave, azimuth_rad=math.pi / 2, **how))


def cell_cut(solve, rng):
    cell, d, wave = pillar(rng)
    film = cell.under[0]
    share = rng.uniform(0.2, 0.8) * film.thickness_um
    parts = (share, film.thickness_um - share)
    films = tuple(cells.Film(film.material, part) for part in parts)
    one = solve(cell, d, wave, tolerance=3e-3)
    cut = solve(dataclasses.replace(cell, under=films), d, wave, tolerance=3e-3)
    return compare(one, cut)


def cell_finer(solve, rng):
    cell, d, wave = pillar(rng)
    rough, fine = (solve(cell, d, wave, tolerance=t) for t in (2e-2, 1e-3))
    return [(rough.t, fine.t, rough.t_error + fine.t_error)]


# light through a map of pillars ---------------------------------------------------


def optics(rng):
    """Phase, transmission and the geometry of a PSF without symmetry."""
    shape = int(rng.integers(24, 30)), int(rng.integers(30, 37))
    phase = rng.uniform(-3, 3, (4, 5))
    y, x = (np.linspace(-1, 1, n) for n in shape)
    smooth = np.polynomial.polynomial.polygrid2d(y, x, phase)
    how = {
        "pitch_um": rng.uniform(0.33, 0.42),
        "wavelength_um": 0.85,
        "sensor_distance_um": rng.uniform(40, 70),
        "depths_um": np.array([300.0, 900.0, np.inf]),
        "angle_rad": tuple(rng.uniform(-0.15, 0.15, 2)),
        "window_um": 14.0,
        "samples": 24,
    }
    return smooth, rng.uniform(0.6, 1.0, shape), how


def pictures(one, other):
    """Pictures agree within their error bars in relative L2, energies likewise."""
    bar = one.error + other.error + 1e-6
    a, b = np.asarray(one.intensity), np.asarray(other.intensity)
    error = np.linalg.norm(a - b, axis=(-2, -1)) / np.linalg.norm(b, axis=(-2, -1))
    ratio = np.asarray(one.energy_um2) / np.asarray(other.energy_um2)
    return [(error.max(), 0.0, bar), (ratio, np.ones_like(ratio), bar)]


def moved(stack, move):
    return dataclasses.replace(stack, intensity=move(np.asarray(stack.intensity)))


def psf_mirror(rng):
    phase, level, how = optics(rng)
    there = psf.psf_stack(phase, level, **how)
    ax, ay = how["angle_rad"]
    sides = [one[:, ::-1] for one in (phase, level)]
    back = psf.psf_stack(*sides, **how | {"angle_rad": (-ax, ay)})
    return pictures(moved(back, lambda p: p[..., ::-1]), there)


def psf_quarter_turn(rng):
    phase, level, how = optics(rng)
    there = psf.psf_stack(phase, level, **how)
    ax, ay = how["angle_rad"]
    turned = [np.rot90(one, -1) for one in (phase, level)]  # +x to +y
    back = psf.psf_stack(*turned, **how | {"angle_rad": (-ay, ax)})
    return pictures(moved(back, lambda p: np.rot90(p, 1, axes=(-2, -1))), there)


def psf_scale(rng):
    phase, level, how = optics(rng)
    s = rng.uniform(0.5, 2.0)
    lengths = {key: s * how[key] for key in how if key.endswith("_um")}
    larger = psf.psf_stack(phase, level, **how | lengths)
    one = dataclasses.replace(larger, energy_um2=larger.energy_um2 / s**2)
    return pictures(one, psf.psf_stack(phase, level, **how))


def psf_linearity(rng):
    phase, level, how = optics(rng)
    c = rng.uniform(0.3, 0.9)
    dim = psf.psf_stack(phase + rng.uniform(-3, 3), c * level, **how)
    dim = dataclasses.replace(dim, energy_um2=dim.energy_um2 / c**2)
    return pictures(dim, psf.psf_stack(phase, level, **how))


def psf_energy(rng):
    phase, level, how = optics(rng)
    how |= {"window_um": 60.0, "samples": 96, "depths_um": np.array([400.0])}
    stack = psf.psf_stack(phase, level, **how)
    passed = (level**2).sum() * how["pitch_um"] ** 2
    # no more light than went in; a pillar is a point, whose plane waves carry 2 %
    # more or less than its cell
    return [(max(float(stack.energy_um2.max()) / passed - 1, 0.0), 0.0, 0.02)]


def psf_cut(rng):
    phase, level, how = optics(rng)
    thick, share = rng.uniform(5, 15), rng.uniform(0.2, 0.8)
    glass = cells.Index(1.52)
    whole = lens.Layers(behind=(cells.Film(glass, thick),))
    parts = tuple(cells.Film(glass, thick * one) for one in (share, 1 - share))
    one = psf.psf_stack(phase, level, **how, layers=whole)
    return pictures(
        psf.psf_stack(phase, level, **how, layers=lens.Layers(behind=parts)), one
    )


def psf_finer(rng):
    phase, level, how = optics(rng)
    rough, fine = (
        psf.psf_stack(phase, level, **how, tolerance=t) for t in (1e-2, 1e-6)
    )
    return pictures(rough, fine)


def psf_colours(rng):
    """Light of two wavelengths is the weighted sum of both, in one window."""
    phase, level, how = optics(rng)
    waves, share = (0.84, 0.86), (0.3, 0.7)
    maps = np.stack([phase, phase]), np.stack([level, level])
    both = psf.psf_stack(*maps, **how | {"wavelength_um": waves}, weights=share)
    each = [psf.psf_stack(phase, level, **how | {"wavelength_um": w}) for w in waves]
    energy = [w * np.asarray(e.energy_um2) for w, e in zip(share, each, strict=True)]
    light = sum(
        e[..., None, None] * one.intensity for e, one in zip(energy, each, strict=True)
    )
    total = sum(energy)
    added = dataclasses.replace(
        each[0], intensity=light / total[..., None, None], energy_um2=total
    )
    return pictures(both, added)


def psf_kinds(rng):
    """Tensors and arrays give the same pictures."""
    phase, level, how = optics(rng)
    tensors = psf.psf_stack(torch.as_tensor(phase), torch.as_tensor(level), **how)
    return pictures(tensors.numpy(), psf.psf_stack(phase, level, **how))


def exact_superposition(rng):
    phase, level, how = optics(rng)
    how["depths_um"] = how["depths_um"][:2]
    half = np.where(rng.random(level.shape) < 0.5, level, 0.0)
    whole, one, other = (
        propagate.exact(phase, part, **how) for part in (level, half, level - half)
    )
    return [(whole, one + other, 1e-9 * np.abs(whole).max())]


# lenses and masks -----------------------------------------------------------------


def made(rng, mirror=False, turn=0.0):
    """A free-form lens of random polynomial phase on the linear proxy."""
    size, c = 6.0, rng.uniform(-2, 2, (3, 4))
    focus = design.Focus(0.85, 40.0, math.inf)
    side = -1.0 if mirror else 1.0

    def phase(x_um, y_um):
        x, y = side * np.asarray(x_um) / size, np.asarray(y_um) / size
        return np.polynomial.polynomial.polygrid2d(y, x, c) + turn

    cell = cells.Cell(
        pitch_um=0.4, pillar=cells.Index(3.6), substrate=cells.Index(1.45)
    )
    return design.make(phase, focus, aperture_um=2 * size, cell=cell, proxy=LINEAR)[0]


def twice(rng, **other):
    """The same random lens as drawn and changed."""
    seed = int(rng.integers(2**31))
    return made(np.random.default_rng(seed)), made(np.random.default_rng(seed), **other)


def design_mirror(rng):
    one, other = (p.diameters.diameter_um for p in twice(rng, mirror=True))
    return [(one, other[:, ::-1], 1e-6)]


def design_turn(rng):
    """A phase is wanted up to whole turns."""
    one, other = (p.diameters.diameter_um for p in twice(rng, turn=4 * math.pi))
    return [(one, other, 1e-6)]


PROCESS = layout.Process()


def shapes(path):
    """(n, 3) middle and area of every pillar that KLayout reads, sorted, um."""
    import klayout.db as db

    drawn = db.Layout()
    drawn.read(str(path))
    rows = []
    for index in drawn.layer_indexes():
        found = db.Region(drawn.top_cell().begin_shapes_rec(index))
        found.merged_semantics = False
        for polygon in found.each():
            middle = polygon.bbox().center()
            rows.append((middle.x, middle.y, polygon.area() * drawn.dbu))
    return np.array(sorted(rows)) * drawn.dbu


def written(one, path):
    plan = layout.plan(one, PROCESS, furnished=False)
    write = layout.write_oasis if path.suffix == ".oas" else layout.write_gdsii
    write(plan, path)
    return path


def mask_mirror(rng, folder):
    one, other = twice(rng, mirror=True)
    there = shapes(written(one, folder / "a.gds"))
    back = shapes(written(other, folder / "b.gds")) * np.array([-1, 1, 1])
    places = [{(round(x, 2), round(y, 2)): a for x, y, a in p} for p in (there, back)]
    off = there[:, 0].min() - back[:, 0].min(), there[:, 1].min() - back[:, 1].min()
    nearest = [
        abs(a - places[1].get((round(x - off[0], 2), round(y - off[1], 2)), math.inf))
        for (x, y), a in places[0].items()
    ]
    return [(len(there), len(back), 0), (max(nearest), 0.0, 1e-6)]


def mask_formats(rng, folder):
    """GDSII and OASIS of a plan hold the same shapes, and read back as planned."""
    one = made(rng)
    plan = layout.plan(one, PROCESS, furnished=False)
    paths = [written(one, folder / name) for name in ("m.oas", "m.gds")]
    reads = (layout.read_oasis(paths[0]), layout.read_gdsii(paths[1]))
    same = [layout.compare(plan, found).ok for found in reads]
    return [(shapes(paths[0]), shapes(paths[1]), 1e-9), (all(same), True, 0)]


def lens_file(rng, folder):
    one = made(rng)
    lens.save(folder / "lens.h5", one)
    back = lens.load(folder / "lens.h5")
    a, b = one.diameters.diameter_um, back.diameters.diameter_um
    return [(a, b, 0), (one.phase_rad(), back.phase_rad(), 0)]


def psf_file(rng, folder):
    phase, level, how = optics(rng)
    one = psf.psf_stack(phase, level, **how)
    psf.save(folder / "psf.h5", one)
    back = psf.load(folder / "psf.h5")
    return [(one.intensity, back.intensity, 0), (one.error, back.error, 0)]


def library_file(rng, folder):
    cell, _, wave = pillar(rng)
    sweep = library.Sweep((wave,), samples=24, tolerance=1e-2)
    one = library.sweep(cell, sweep)
    library.save(folder / "library.h5", one)
    back = library.load(folder / "library.h5")
    return [(one.t, back.t, 0), (one.t_error, back.t_error, 0)]


CELLS = (cell_energy, cell_scale, cell_reciprocity, cell_mirror, cell_quarter_turn,
         cell_cut, cell_finer)  # fmt: skip
LIGHT = (psf_mirror, psf_quarter_turn, psf_scale, psf_linearity, psf_energy, psf_cut,
         psf_finer, psf_colours, psf_kinds, exact_superposition, design_mirror,
         design_turn)  # fmt: skip
FILES = (mask_mirror, mask_formats, lens_file, psf_file, library_file)
