"""The light of pillars on a small window of the sensor, for many amplitude maps at
once, without torch.
"""

from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.lens import Lens, reach
from metalens.propagate import PropagationCase, make_case, paths

_ON_AXIS = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class FocusWindow:
    """Where on the sensor the light is evaluated.

    x_um, y_um: (x,), (y,) positions on the sensor. distance_um: lens to sensor.
    depths_um: (depths,) distances of the source on the axis; inf for a collimated beam.
    """

    x_um: Array
    y_um: Array
    distance_um: float
    wavelength_um: float
    depths_um: Array


@dataclass(frozen=True, eq=False)
class FocusSums:
    """Sums over the pillars of a lens, prepared for one window.

    case: the lens with its films. x_um, y_um: positions of the sites. nodes_x_um,
    nodes_y_um: of the nodes. onto_x, onto_y: (nodes, sites) polynomial basis, float32.
    curvature: 1 / depth of the reference source whose phase is taken off.
    """

    window: FocusWindow
    case: PropagationCase
    x_um: Array
    y_um: Array
    nodes_x_um: Array
    nodes_y_um: Array
    onto_x: Array
    onto_y: Array
    curvature: float

    def project(
        self, amplitudes: Array, rows: slice = slice(None), columns: slice = slice(None)
    ) -> Array:
        """(maps, nodes y, nodes x) sums of the amplitudes (maps, y, x) of a block of
        sites against the basis.
        """
        x, y = self.x_um[columns], self.y_um[rows, None]
        flattened = amplitudes * np.exp(1j * self._carrier_rad(x, y)).astype(
            np.complex64
        )
        along = flattened @ self.onto_x[:, columns].T.astype(np.complex64)
        return np.asarray(self.onto_y[:, rows].astype(np.complex64) @ along)

    def light(
        self, moments: Array, shift_um: tuple[float, float] = (0.0, 0.0)
    ) -> Array:
        """Complex amplitude on the window, (maps, depths, y, x).

        sum over the nodes of moments * exp(i (source phase - carrier)) * kernel, with
        the kernel area * factor * exp(i k path) from node to sample.

        Args:
            moments: (maps, nodes y, nodes x) from :meth:`project`.
            shift_um: (x, y) by which the pillars stand off their sites.
        """
        window = self.window
        k = self.case.wavenumber
        nodes_x = self.nodes_x_um + shift_um[0]
        nodes_y = self.nodes_y_um[:, None] + shift_um[1]
        carrier = self._carrier_rad(self.nodes_x_um, self.nodes_y_um[:, None])
        inverse_depths = np.array(self.case.inverse_depths_per_um)[:, None, None]
        sources = np.exp(
            1j * (self._phase_rad(nodes_x, nodes_y, inverse_depths) - carrier)
        ).reshape(len(inverse_depths), -1)
        weights = moments.reshape(len(moments), 1, -1) * sources
        weights = weights.reshape(-1, weights.shape[-1]).T.astype(np.complex64)
        rows = []
        for y in window.y_um:
            factor, path = paths.ray_to_offset(
                self.case, nodes_x, nodes_y, window.x_um[:, None, None], y
            )
            kernel = (
                self.case.area_um2
                * factor
                * np.exp(1j * np.remainder(k * path, 2 * np.pi))
            )
            rows.append(
                kernel.reshape(len(window.x_um), -1).astype(np.complex64) @ weights
            )
        field = np.stack(rows).transpose(2, 0, 1)
        return np.asarray(
            field.reshape(len(moments), len(window.depths_um), *field.shape[1:])
        )

    def _carrier_rad(self, x_um: Array, y_um: Array) -> Array:
        """Phase that is taken off: from the reference source over the lens to the
        middle of the window.
        """
        return self._phase_rad(x_um, y_um, self.curvature)

    def _phase_rad(
        self, x_um: Array, y_um: Array, inverse_depth: Array | float
    ) -> Array:
        """Phase from a source on the axis, over (x, y) on the lens, to the sensor."""
        path = paths.to_sensor(self.case, x_um, y_um) + paths.from_source(
            self.case, x_um, y_um, _ON_AXIS, inverse_depth
        )
        return np.asarray(np.remainder(self.case.wavenumber * path, 2 * np.pi))


def check_study_lens(lens: Lens) -> None:
    """Refuse a lens that no study takes, before any work: one behind a stop."""
    if lens.layers.stop is not None:
        raise PropagationError(
            f"a lens behind a stop of {2 * lens.layers.stop.radius_um:g} um is not studied: its pillars are summed "
            "once for all depths, and a stop lights others at each; study the same lens designed without layers.stop"
        )


def prepare_focus(lens: Lens, window: FocusWindow) -> FocusSums:
    """Basis for a lens and a window; as many nodes as the phase between them turns, and
    12 more.

    Accuracy:
        float32 sums, about 1e-5 of the largest amplitude of the window.

    Raises:
        PropagationError: a window of fewer than 2 samples a side, a lens of fewer than
            2 sites a side, or one behind a
            stop, whose shadow is another at each depth where these sums are shared by
            all.
    """
    check_study_lens(lens)
    if min(len(window.x_um), len(window.y_um), *lens.diameters.diameter_um.shape) < 2:
        raise PropagationError(
            "the window and the lens need 2 samples and sites a side or more"
        )
    case = make_case(
        lens.diameters.diameter_um.shape,
        **lens.diameters.grid._asdict(),
        wavelength_um=window.wavelength_um,
        sensor_distance_um=window.distance_um,
        depths_um=window.depths_um,
        window_um=1.0,
        samples=1,
        layers=lens.layers,
    )
    curvature = paths.reference_depth(case)
    x, y = lens.diameters.x_um, lens.diameters.y_um
    count_x = _count(case, float(x[-1]), float(abs(window.x_um).max()), curvature)
    count_y = _count(case, float(y[-1]), float(abs(window.y_um).max()), curvature)
    (nodes_x, onto_x), (nodes_y, onto_y) = _basis(x, count_x), _basis(y, count_y)
    return FocusSums(window, case, x, y, nodes_x, nodes_y, onto_x, onto_y, curvature)


def focus_window(lens: Lens, *, depths_um: Array | None = None) -> FocusWindow:
    """A window around the axis that holds the blur at all depths.

    Samples are a quarter of wavelength / NA apart, the Nyquist step of the intensity.
    Six diffraction widths surround the blur.

    Args:
        lens: as designed.
        depths_um: of the source; None: the source distance of the design.
    """
    depths = np.array(
        [lens.source_distance_um] if depths_um is None else depths_um, float
    )
    step = reach.diffraction_um(lens) / 4
    blur = max(reach.blur_um(lens, depth) for depth in depths)
    half = int(np.ceil((blur + 12 * step) / step))
    axis = np.arange(-half, half + 1) * step
    return FocusWindow(axis, axis, lens.sensor_distance_um, lens.wavelength_um, depths)


def _count(
    case: PropagationCase, edge_um: float, reach_um: float, curvature: float
) -> int:
    """Number of Chebyshev nodes along an axis.

    With the phase amplitude a = k * max|d path / dx| * edge, over the depths and less
    the carrier, the series needs a + 4 a^(1/3) terms (decay of Bessel functions), and 12 more.

    Args:
        case: the lens with its films.
        edge_um: half width of the lens.
        reach_um: half width of the window.
        curvature: 1 / depth of the reference source.
    """
    x = np.linspace(-edge_um, edge_um, 1001)
    reference_path = paths.ray_to_offset(case, x, 0.0, reach_um, 0.0)[
        1
    ] - paths.from_source(case, x, 0.0, _ON_AXIS, curvature)
    differences = [
        reference_path + paths.from_source(case, x, 0.0, _ON_AXIS, inverse_depth)
        for inverse_depth in case.inverse_depths_per_um
    ]
    slope = max(float(abs(np.gradient(path, x)).max()) for path in differences)
    turns = case.wavenumber * slope * edge_um
    return int(np.ceil(turns + 4 * turns ** (1 / 3))) + 12


def _basis(sites_um: Array, count: int) -> tuple[Array, Array]:
    """(nodes, (nodes, sites) Lagrange basis on Chebyshev points, by their discrete
    orthogonality).
    """
    edge = sites_um[-1]
    angle = np.pi * (np.arange(count) + 0.5) / count
    order = np.arange(count)
    at_nodes = np.cos(np.outer(order, angle))
    at_nodes[0] /= 2
    at_sites = np.cos(np.outer(order, np.arccos(sites_um / edge)))
    return np.asarray(edge * np.cos(angle)), (2 / count * at_nodes.T @ at_sites).astype(
        np.float32
    )
