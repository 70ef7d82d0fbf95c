"""RCWA of round pillars: true error, honesty of the estimate, power and time per solve.

References: the modal method on elements that follow the disc, an independent solver, at
1e-4; for films the
characteristic matrices of colour-science. ``peer_rows`` runs fmmax on the same pillars.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks import Row, fastest
from metalens import modal, rcwa
from metalens.cell.record import Cell, Film, Index
from metalens.cell.response import Response

DIAMETERS = np.round(np.arange(0.08, 0.3201, 0.02), 3)
CELLS = {
    0.85: Cell(0.40, 0.7, pillar=Index(3.6), substrate=Index(1.4525)),
    0.94: Cell(0.40, 0.7, pillar=Index(3.6), substrate=Index(1.4513)),
}
REFERENCE_TOLERANCE = 1e-4


def rows() -> list[Row]:
    found = []
    for wavelength_um, cell in CELLS.items():
        exact = reference(cell, wavelength_um)
        found += [
            truncated_row(cell, wavelength_um, exact, harmonics)
            for harmonics in (7, 9, 11, 13, 16)
        ]
    return [*found, oblique_row(), tilted_row(), film_row()]


def reference(cell: Cell, wavelength_um: float) -> np.ndarray[Any, np.dtype[Any]]:
    found = [
        modal.solve(cell, d, wavelength_um, tolerance=REFERENCE_TOLERANCE).t
        for d in DIAMETERS
    ]
    return np.array(found)


def truncated_row(cell: Cell, wavelength_um: float, exact: Any, harmonics: int) -> Row:
    """Error and estimate at one truncation; the time is that of this truncation alone."""
    found = [rcwa.solve(cell, d, wavelength_um, harmonics=harmonics) for d in DIAMETERS]

    def work() -> None:
        for diameter_um in DIAMETERS:
            rcwa.solve_truncation(cell, diameter_um, wavelength_um, harmonics=harmonics)

    seconds = fastest(work, repeats=2) / len(DIAMETERS)
    error = np.abs(np.array([one.t for one in found]) - exact)
    return Row(
        f"{len(DIAMETERS)} pillars 80-320 nm at {wavelength_um * 1e3:.0f} nm, each",
        f"orders within {harmonics}",
        seconds,
        float(error.max()),
        "max |dt|, modal method at 1e-4",
        goal=f"<= 1e-2; {honesty(found, error)}, power {defect(found):.0e}",
    )


def honesty(found: Sequence[Response], error: Any) -> str:
    """Largest true error over its estimate."""
    ratio = (error / np.array([one.t_error for one in found])).max()
    return f"true / estimate <= {ratio:.2f} (goal 3)"


def defect(found: Sequence[Response]) -> float:
    return max(abs(one.energy - 1) for one in found)


def oblique_row() -> Row:
    """A conical direction has no symmetry left; the reference is its mirror image in
    the diagonal.
    """
    cell, angle = CELLS[0.85], math.radians(10)

    def at(azimuth_rad: float) -> Response:
        return rcwa.solve(
            cell,
            0.2,
            0.85,
            angle_rad=angle,
            azimuth_rad=azimuth_rad,
            polarization="s",
            harmonics=6,
        )

    error = abs(at(0.3).t - at(math.pi / 2 - 0.3).t)
    seconds = fastest(lambda: at(0.3), repeats=1)
    return Row(
        "conical, 10 deg",
        "orders within 2 to 6",
        seconds,
        error,
        "mirror image in the diagonal",
        goal="1e-12",
    )


def tilted_row() -> Row:
    """Reciprocity of a cone: foot and top exchanged."""
    from dataclasses import replace

    cell = replace(CELLS[0.85], sidewall_rad=math.radians(2))
    back = replace(
        cell,
        substrate=cell.cover,
        cover=cell.substrate,
        between=cell.fill,
        sidewall_rad=-cell.sidewall_rad,
    )
    there = rcwa.solve(cell, 0.2, 0.85, harmonics=7)
    error = abs(there.t - rcwa.solve(back, 0.2, 0.85, harmonics=7).t)
    seconds = fastest(lambda: rcwa.solve(cell, 0.2, 0.85, harmonics=7), repeats=1)
    return Row(
        "wall tilted by 2 deg",
        "orders within 3 to 7",
        seconds,
        error,
        "swap of sides",
        goal="reciprocity 1e-12",
    )


def film_row() -> Row:
    import colour.phenomena

    under = (Film(Index(2.0), 0.12), Film(Index(1.38), 0.2))
    cell = Cell(0.4, 0.0, pillar="air", substrate=Index(1.4525), under=under)
    R, _ = colour.phenomena.multilayer_tmm(
        np.array([1.4525, 2.0, 1.38, 1.0]), np.array([120.0, 200.0]), 850.0
    )[:2]
    error = abs(abs(rcwa.solve(cell, 0.0, 0.85).r) ** 2 - float(np.ravel(R)[0]))
    seconds = fastest(lambda: rcwa.solve(cell, 0.0, 0.85))
    return Row(
        "two films",
        "film limit",
        seconds,
        error,
        "|r|^2 of colour-science multilayer_tmm",
        goal="1e-10",
    )


def peer_rows() -> list[Row]:
    """fmmax, its fastest formulation, compiled, on the same pillars."""
    exact = reference(CELLS[0.85], 0.85)
    return [fmmax_row(exact, harmonics) for harmonics in (7, 9)]


def fmmax_row(exact: Any, harmonics: int) -> Row:
    solve = fmmax_solver(CELLS[0.85], 0.85, harmonics)
    error = max(
        abs(complex(solve(d)) - t) for d, t in zip(DIAMETERS, exact, strict=True)
    )
    seconds = fastest(lambda: complex(solve(0.2)), repeats=2)
    return Row(
        f"{len(DIAMETERS)} pillars 80-320 nm at 850 nm, each",
        f"fmmax JONES_DIRECT_FOURIER, orders within {harmonics}",
        seconds,
        float(error),
        "max |dt|, modal method at 1e-4",
    )


def fmmax_solver(
    cell: Cell, wavelength_um: float, harmonics: int
) -> Callable[[float], Any]:
    """A compiled function from the diameter to the power-normalised transmission."""
    import fmmax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    lattice = fmmax.LatticeVectors(u=cell.pitch_um * fmmax.X, v=cell.pitch_um * fmmax.Y)
    reach = np.arange(-harmonics, harmonics + 1)
    terms = int(np.count_nonzero(reach[:, None] ** 2 + reach**2 <= harmonics**2))
    expansion = fmmax.generate_expansion(
        lattice, terms, fmmax.TruncatedSolution.CIRCULAR
    )

    def modes(permittivity: Any) -> Any:
        return fmmax.eigensolve_isotropic_media(
            wavelength=jnp.asarray(wavelength_um),
            in_plane_wavevector=jnp.zeros(2),
            primitive_lattice_vectors=lattice,
            permittivity=permittivity,
            expansion=expansion,
            formulation=fmmax.Formulation.JONES_DIRECT_FOURIER,
        )

    n_substrate, n_pillar = index(cell.substrate), index(cell.pillar)

    @jax.jit
    def transmission(permittivity: Any) -> Any:
        layers = [
            modes(jnp.full((1, 1), n_substrate**2)),
            modes(permittivity),
            modes(jnp.full((1, 1), 1.0 + 0j)),
        ]
        heights = [jnp.asarray(height) for height in (0.0, cell.height_um, 0.0)]
        return fmmax.stack_s_matrix(layers, heights).s11[0, 0] * jnp.sqrt(
            n_substrate.real
        )

    return lambda diameter_um: transmission(
        jnp.asarray(1 + (n_pillar**2 - 1) * disc(diameter_um / cell.pitch_um))
    )


def index(material: object) -> complex:
    from metalens import materials

    return materials.index(material, 0.85)  # type: ignore[arg-type]


def disc(ratio: float, pixels: int = 256, fine: int = 8) -> Any:
    """Share of each pixel of the cell that a disc of this diameter over pitch covers."""
    x = (np.arange(pixels * fine) + 0.5) / (pixels * fine) - 0.5
    inside = x[:, None] ** 2 + x**2 < ratio**2 / 4
    return inside.reshape(pixels, fine, pixels, fine).mean(axis=(1, 3))
