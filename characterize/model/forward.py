"""Expected frames of an as-built lens on its bench, with derivatives by every
parameter, on coarse nodes.
"""

import copy
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from characterize.model import detector
from characterize.model.compressed import (
    CompressedLens,
    CouplingTerms,
    WindowOperators,
    wrapped_phasors,
)
from characterize.model.glass import BenchGeometry, FilmStack, source_paths
from characterize.model.parameters import PARAMETERS, PLACE
from characterize.model.pillars import (
    PillarResponse,
    incidence_rad,
    of_lens,
    pillar_change_of,
)
from characterize.model.setting import (
    AngleGroup,
    FrameSetting,
    SpectralLine,
    background_planes,
    true_depth,
)
from metalens.core import threads
from metalens.core.arrays import Array
from metalens.fabrication import CDError, ResponseError, Sensitivity, names_of_kind
from metalens.lens import Lens

GEOMETRY = (
    "distance_um", "wavelength_nm", "decentre_x_um", "decentre_y_um", "tilt_x_deg", "tilt_y_deg", "source_x_um",
    "source_y_um", "stage_zero_um", "stage_scale", "glass_um", "glass_tilt_x_deg", "glass_tilt_y_deg",
)  # fmt: skip
CD_ERRORS, RESPONSE_ERRORS = (
    {name: n for n, name in enumerate(names_of_kind(kind))}
    for kind in (CDError, ResponseError)
)
# parameters that act behind the intensity, by source, sensor and background
_OF_DETECTION = (
    "distance_um", "stage_zero_um", "stage_scale", "pinhole_um", "crosstalk_px",
    "log_gain", "background_e", "background_x_e", "background_y_e",
)  # fmt: skip
Light = tuple[Array, dict[str, Array]]  # light, and its derivatives by name
# relative error of derivatives: it slows the last steps of a fit, not its result
_SLOPE_TOLERANCE = 8e-3
# relative step of distance and wavelength in the kernel: truncation, (step times phase)²
# / 6, is as small as rounding, 1e-7 over the step
_KERNEL_STEP = 5e-4
# of difference quotients: typical uncertainties, bandwidth, bias
_STEP, _WIDER_NM, _BIAS_STEP_UM = 0.02, 0.02, 2e-5
# pixels: least disc of a derivative, as a point has no slope by its size
_LEAST_DISC_PX = 0.3
_PITCH = PLACE["pixel_percent"]
# offset from the chief ray up to which a window needs no further directions
_NEAR_UM = 5.0


class ForwardModel:
    """Frames (n, rows, columns) in electrons as a function of
    :data:`parameters.PARAMETERS`.

    Accuracy: ``Pillars.error`` in the transmission of pillars, ``setting.tolerance``
    in the field. A test and the benchmark compare both with the sum over all pillars.
    """

    def __init__(
        self, lens: Lens, setting: FrameSetting, response: Sensitivity
    ) -> None:
        """Gather the lens for every field angle of the frames.

        Args:
            lens: the design.
            setting: depths, angles and window of the frames.
            response: slopes of the pillars.
        """
        self.lens = lens
        self.setting = s = setting
        self.reference_um = float(
            2 / (1 / setting.depth_um.min() + 1 / setting.depth_um.max())
        )
        over = detector.required_oversampling(lens, setting.pixel_um)
        self.grid = detector.DetectorGrid(
            s.rows, s.columns, s.pixel_um, over, s.margin, fill=s.fill
        )
        self.response = response
        self._lean_um = 0.0
        self._pillars: dict[float, PillarResponse] = {}  # by angle of incidence
        self.films = FilmStack.of(lens.layers, lens.wavelength_um)
        self.area_um2 = (
            float((lens.diameters.diameter_um > 0).sum()) * lens.diameters.site_um2
        )
        self.stage_centre_um = float(setting.depth_um.mean())
        self.spectrum = SpectralLine.of(
            lens, setting.depth_um, setting.angle_rad, tolerance=setting.tolerance
        )
        self.groups = [
            self._group(angle) for angle in np.unique(setting.angle_rad, axis=0)
        ]

    def _group(self, angle_rad: Array) -> AngleGroup:
        """Nodes, pillars and gathered fields of one field angle (x, y), rad.

        The nodes serve depths from 15 % below the nearest to 15 % above the farthest.
        Pillars are shared by angles of one incidence.
        """
        setting = self.setting
        index = np.flatnonzero((setting.angle_rad == angle_rad).all(1))
        tangents = math.tan(angle_rad[0]), math.tan(angle_rad[1])
        bench = BenchGeometry(
            self.lens.sensor_distance_um,
            self.lens.wavelength_um,
            self.reference_um,
            tangents,
        )
        window = self.grid.across_um(_NEAR_UM)
        depths = np.array(
            [0.85 * setting.depth_um.min(), 1.15 * setting.depth_um.max()]
        )
        incidence = incidence_rad(self.lens.proxy, angle_rad)
        if incidence not in self._pillars:
            self._pillars[incidence] = of_lens(
                self.lens, self.response, angle_rad=incidence
            )
        pillars = self._pillars[incidence]
        reduced = CompressedLens(
            self.lens,
            pillars,
            bench,
            window_um=window,
            depths_um=depths,
            tolerance=setting.tolerance,
        )
        return AngleGroup.of(index, pillars, reduced).shaded(
            self.lens, setting.depth_um
        )

    def only(self, frames: Array) -> "ForwardModel":
        """The model of some frames, in rising order of their index.

        It shares all gathered fields with this one.

        Args:
            frames: (k,) indices.
        """
        part = copy.copy(self)
        s = self.setting
        part.setting = dataclasses.replace(
            s,
            depth_um=s.depth_um[frames],
            angle_rad=s.angle_rad[frames],
            exposure=s.exposure[frames],
        )
        groups = [group.only(frames) for group in self.groups]
        part.groups = [group for group in groups if group is not None]
        return part

    def about(self, middle_um: tuple[float, float]) -> "ForwardModel":
        """The same model, the window's middle fixed at (x, y) um from the chief ray.

        Decentre acts as a phase about that middle. Of a point X from the middle this
        misses the phase k decentre X 1.5 sin² / d. A window far from the chief ray
        gets nodes of its own.
        """
        part = copy.copy(self)
        reach = max(
            _NEAR_UM, *(abs(v) + self.setting.pixel_um for v in self.grid.middle_um)
        )
        part.grid = dataclasses.replace(
            self.grid, middle_um=(float(middle_um[0]), float(middle_um[1]))
        )
        if max(abs(v) for v in middle_um) > reach:  # needs more directions
            angles_rad = np.unique(self.setting.angle_rad, axis=0)
            part.groups = [part._group(angle_rad) for angle_rad in angles_rad]
        return part

    def with_pixel_pitch(self, ratio: float) -> "ForwardModel":
        """The same model with pixels of ``ratio`` times the pitch and the width."""
        part = copy.copy(self)
        pixel_um = self.setting.pixel_um * ratio
        part.setting = dataclasses.replace(self.setting, pixel_um=pixel_um)
        part.grid = dataclasses.replace(self.grid, pixel_um=pixel_um)
        return part

    def with_walls(self, angle_rad: float) -> "ForwardModel":
        """The same lens with side walls leaning by an angle about half height.

        Its derivatives are those of upright walls.
        """
        part = copy.copy(self)
        part._lean_um = math.tan(angle_rad) * self.lens.cell.height_um
        return part

    def with_residual(self, shapes: Callable[[Array, Array], Array]) -> "ForwardModel":
        """The same model with derivatives by further phases ``residual_0``,
        ``residual_1`` and so on.

        Args:
            shapes: (u, v) of places on the lens over its radius to (m, *shape) phases
                in rad; imaginary parts attenuate.
        """
        part = copy.copy(self)
        part.groups = []
        for group in self.groups:
            maps = shapes(group.reduced.u, group.reduced.v)
            named = {f"residual_{k}": phase for k, phase in enumerate(maps)}
            part.groups.append(group.with_phases(named))
        return part

    def images(
        self, x: Array, names: Sequence[str] | None = None
    ) -> tuple[Array, Array | None]:
        """Expected frames (n, rows, columns) in electrons, and their derivatives.

        Frame = intensity |E|² through the response of :meth:`_detection` + background.

        Args:
            x: all parameters, in the order of ``PARAMETERS``.
            names: parameters to differentiate by.

        Returns:
            Frames, and derivatives (len(wanted), n, rows, columns) or None.
        """
        model = self.with_pixel_pitch(1 + float(x[_PITCH]) / 100)
        response, background = model._detection(x, model._source_images(x))
        light, slopes = model._light(x, names or (), response)
        frames = model.grid.sample(light, response) + background
        if names is None:
            return frames, None
        for name in names:
            if name in _OF_DETECTION:
                slopes[name] = slopes[name] + model._detection_slope(x, name, light)
            elif name == "pixel_percent":
                slopes[name] = self._pitch_slope(x)
        return frames, np.stack([slopes[name] for name in names])

    def _detection(self, x: Array, sizes_um: Array) -> tuple[Array, Array]:
        """(n, fy, fx) response of the frames to the intensity behind a lens that light
        of unit density illuminates, and (n, rows, columns) background, electrons.

        Response = gain * exposure * pixel area * (reference depth / depth)² / lens area
        times the transfer of pixel, crosstalk and source; depths in air.

        Args:
            sizes_um: (n,) diameters of the source's images.
        """
        s = self.setting
        depth_um = self.films.apparent_um(
            true_depth(x, s.depth_um, self.stage_centre_um)
        )
        # bounded, so that a trial step far off does not overflow
        gain = np.exp(min(x[PLACE["log_gain"]], 100.0)) / self.area_um2
        width = s.fill * s.pixel_um * self.films.apparent_um(self.reference_um)
        brightness = gain * s.exposure * (width / depth_um) ** 2
        transfer = detector.detector_transfer(
            self.grid, x[PLACE["crosstalk_px"]], sizes_um
        )
        return brightness[:, None, None] * transfer, background_planes(x, s)

    def _detection_slope(self, x: Array, name: str, light: Array) -> Array:
        """(n, rows, columns) derivative of the frames by a parameter through
        :meth:`_detection` alone: a central difference.

        By the source's size it is that of a disc of least size, as a point has none.

        Args:
            light: (n, y, x) intensity on the fine samples.
        """
        shift = difference_step(x, name)
        ends = []
        for moved in (x + shift, x - shift):
            sizes_um = self._source_images(moved)
            if name == "pinhole_um":
                least_um = _LEAST_DISC_PX * self.grid.wide_um
                at_rest = self._source_images(x)
                sizes_um = sizes_um - at_rest + np.maximum(at_rest, least_um)
            ends.append(self._detection(moved, sizes_um))
        response, background = (
            (up - down) / (2 * shift.sum()) for up, down in zip(*ends, strict=True)
        )
        return np.asarray(self.grid.sample(light, response) + background)

    def _source_images(self, x: Array) -> Array:
        """(n,) diameters of the source's images: paraxial sensor over source distance.

        Paraxial light bends over distances reduced to air as over the actual ones.
        """
        depth_um = true_depth(x, self.setting.depth_um, self.stage_centre_um)
        distance_um = self.lens.sensor_distance_um + x[PLACE["distance_um"]]
        image_um = self.films.reduced_um(distance_um) * x[PLACE["pinhole_um"]]
        return np.asarray(image_um / self.films.apparent_um(depth_um))

    def _pitch_slope(self, x: Array) -> Array:
        """(n, rows, columns) derivative by the pixel pitch per percent: central
        difference over 0.3 percent.
        """
        step = 0.3 * (np.arange(len(x)) == _PITCH)
        up, down = (self.images(at)[0] for at in (x + step, x - step))
        return np.asarray((up - down) / (2 * step.sum()))

    def _light(
        self,
        x: Array,
        wanted: Sequence[str],
        response: Array,
        like_nm: float | None = None,
    ) -> Light:
        """(n, y, x) intensity |E|² on the fine samples, and by name the change of the
        frames by its derivatives.

        Sum over spectral samples and field angles. The derivative by the bandwidth is
        a forward difference.

        Args:
            wanted: parameters to differentiate by.
            response: (n, fy, fx) of the frames to the intensity.
            like_nm: bandwidth whose spectral samples are used; default: that of ``x``.
        """
        s = self.setting
        bandwidth_nm = float(x[PLACE["bandwidth_nm"]])
        acting = list(
            dict.fromkeys(
                "stage_zero_um" if name == "stage_scale" else name for name in wanted
            )
        )
        light = np.zeros((len(s.depth_um), *self.grid.fine_shape))
        slopes = {name: np.zeros((len(light), s.rows, s.columns)) for name in acting}
        for offset_nm, weight in self.spectrum.colours(bandwidth_nm, like_nm):
            at = x.copy()
            at[PLACE["wavelength_nm"]] += offset_nm
            for group in (g for whole in self.groups for g in whole.illuminated_parts):
                intensity, changes = self._intensity(at, group, acting)
                light[group.index] += weight * intensity
                for name, change in changes:
                    sampled = self.grid.sample(change, response[group.index])
                    slopes[name][group.index] += weight * sampled
        if "bandwidth_nm" in wanted:
            widened = x + _WIDER_NM * (np.arange(len(x)) == PLACE["bandwidth_nm"])
            wider = self._light(widened, (), response, bandwidth_nm)[0]
            slopes["bandwidth_nm"] = self.grid.sample(
                (wider - light) / _WIDER_NM, response
            )
        if "stage_scale" in wanted:
            # d/d(scale) = (depth - mean depth) d/d(stage zero)
            off_um = s.depth_um - self.stage_centre_um
            slopes["stage_scale"] = slopes["stage_zero_um"] * off_um[:, None, None]
        return light, slopes

    def _intensity(
        self, x: Array, group: AngleGroup, names: Sequence[str]
    ) -> tuple[Array, Iterator[tuple[str, Array]]]:
        """(frames, y, x) intensity of one field angle at one wavelength, and its
        derivatives by those of ``names`` that act on the field.

        Field E = K P exp(i phi): kernel K of nodes to window, pupil P, phase phi. The
        derivative of |E|² is 2 Re(E* dE).

        Args:
            x: all parameters.
            group: lens and frames of the field angle.
        """
        operators, phasor, pupil = threads.run_concurrently(
            lambda: self._operators(x, group),
            lambda: wrapped_phasors(self._phase(x, group)),
            lambda: self._pupil(x, group),
        )
        lens_field = (pupil * phasor).astype(phasor.dtype)
        field = operators.envelope(operators.coarse(lens_field))
        intensity = field.real**2 + field.imag**2
        power = np.vdot(lens_field, lens_field).real

        def changes() -> Iterator[tuple[str, Array]]:
            for name, slope in self._lens_slopes(x, group, names, pupil, phasor):
                # the part of the derivative along the field itself: exact without a sum
                along = np.vdot(lens_field, slope) / power
                slope = slope - along * lens_field
                in_kernel = name in ("distance_um", "wavelength_nm")
                # the slope of the kernel nearly cancels that of the lens
                cut = 0.0 if in_kernel else _SLOPE_TOLERANCE
                field_slope = operators.coarse(slope, cut)
                if in_kernel:
                    terms = operators.terms
                    field_slope += self._kernel_slope(x, group, name, lens_field, terms)
                field_slope = operators.envelope(field_slope)
                change = 2 * (field.conj() * field_slope).real
                yield name, change + 2 * along.real * intensity

        return intensity, changes()

    def _lens_slopes(
        self,
        x: Array,
        group: AngleGroup,
        names: Sequence[str],
        pupil: Array,
        phasor: Array,
    ) -> Iterator[tuple[str, Array]]:
        """(frames, q, p) derivatives of the field on the nodes by the ``names`` that act
        on it; the derivative of the kernel is left out.

        Args:
            pupil: (q, p) of :meth:`_pupil`.
            phasor: (frames, q, p) exp(i phase).
        """
        by_bias = None
        for name in names:
            if name in CD_ERRORS:
                if by_bias is None:
                    wider, narrower = (
                        self._pupil(x, group, sign * _BIAS_STEP_UM) for sign in (1, -1)
                    )
                    by_bias = (wider - narrower) / (2 * _BIAS_STEP_UM)
                slope = by_bias * group.cd_maps[CD_ERRORS[name]] * phasor
            elif name in group.phase_maps:
                slope = 1j * group.phase_maps[name] * pupil * phasor
            elif name in GEOMETRY or name in RESPONSE_ERRORS:
                shift = difference_step(x, name)
                slope = 0.0
                if name in GEOMETRY:
                    up, down = (self._phase(at, group) for at in (x + shift, x - shift))
                    slope = 1j * (up - down) * pupil
                if name not in GEOMETRY or name == "wavelength_nm":
                    up, down = (self._pupil(at, group) for at in (x + shift, x - shift))
                    slope = slope + (up - down)
                slope = slope * (phasor / (2 * shift.sum()))
            else:
                continue
            yield name, np.asarray(slope.astype(phasor.dtype))

    def _pupil(self, x: Array, group: AngleGroup, more_um: float = 0.0) -> Array:
        """(q, p) complex transmission of the pillars on the lens nodes.

        Args:
            more_um: added to the bias, which is clipped to the range of the pillars.
        """
        bias = np.tensordot([x[PLACE[name]] for name in CD_ERRORS], group.cd_maps, 1)
        reach = group.pillars.span.bias_um
        bias = np.clip(bias + more_um, -reach, reach)
        values = group.pillars.coefficients(pillar_change_of(x), self._lean_um)
        return group.reduced.combined(group.pillars.weights(bias), values)

    def _phase(self, x: Array, group: AngleGroup) -> Array:
        """(frames, q, p) smooth phase on the lens nodes, rad.

        k (source path + sensor path) less the phase taken off before, plus aberrations
        and, as an imaginary part, the unevenness of the illumination.
        """
        reduced = group.reduced
        index = group.index
        nominal = group.reduced.bench
        places = reduced.x_um, reduced.y_um
        wavelength_um = nominal.wavelength_um + x[PLACE["wavelength_nm"]] * 1e-3
        k = 2 * math.pi / wavelength_um
        distance_um = nominal.distance_um + x[PLACE["distance_um"]]
        tilt = [math.tan(math.radians(x[PLACE[f"tilt_{a}_deg"]])) for a in "xy"]
        tx = nominal.tangents[0] + tilt[0]
        ty = nominal.tangents[1] + tilt[1]
        middle = self.grid.middle_um
        chief = reduced.films.chief_um(distance_um, (tx, ty))
        centre = (
            chief[0] + x[PLACE["decentre_x_um"]] - middle[0],
            chief[1] + x[PLACE["decentre_y_um"]] - middle[1],
        )
        films = FilmStack.of(self.lens.layers, wavelength_um)
        exit_path = films.sensor_path(*places, centre, distance_um)
        depth = true_depth(x, self.setting.depth_um, self.stage_centre_um)[index]
        phase = source_paths(
            *places, depth_um=depth, tangents=(tx, ty), values=x, films=films
        )
        phase += exit_path
        phase *= k
        phase -= reduced.known
        errors = {
            name: float(x[PLACE[name]]) for name in group.phase_maps if name in PLACE
        }
        return phase + sum(
            value * group.phase_maps[name] for name, value in errors.items() if value
        )

    def _operators(
        self, x: Array, group: AngleGroup, terms: CouplingTerms | None = None
    ) -> WindowOperators:
        """Operators of wavelength and distance, by the coupling ``terms`` of some cell;
        by those of its own without them.
        """
        nominal = group.reduced.bench
        distance_um = nominal.distance_um + x[PLACE["distance_um"]]
        if terms is None:
            terms = group.reduced.coupling(distance_um, self.grid.axes_um())
        wavelength_um = nominal.wavelength_um + x[PLACE["wavelength_nm"]] * 1e-3
        return group.reduced.operators(
            terms, wavelength_um=wavelength_um, distance_um=distance_um
        )

    def _kernel_slope(
        self, x: Array, group: AngleGroup, name: str, light: Array, terms: CouplingTerms
    ) -> Array:
        """(frames, Y, X) derivative of the coarse field by the kernel alone, by a
        central difference over the distance or the wavelength.

        Args:
            light: (frames, q, p) field on the nodes.
            terms: of the cell of the distance in ``x``.
        """
        bench = group.reduced.bench
        scale = (
            bench.distance_um if name == "distance_um" else 1e3 * bench.wavelength_um
        )
        step = _KERNEL_STEP * scale
        shift = step * (np.arange(len(x)) == PLACE[name])
        up, down = (
            self._operators(x + sign * shift, group, terms).coarse(light)
            for sign in (1, -1)
        )
        return np.asarray((up - down) * np.float32(0.5 / step))


def difference_step(x: Array, name: str) -> Array:
    """(parameters,) step of a difference quotient by one parameter.

    Args:
        x: all parameters.
        name: of the one that moves.
    """
    size = _STEP * PARAMETERS[PLACE[name]].scale
    return np.asarray(size * (np.arange(len(x)) == PLACE[name]))
