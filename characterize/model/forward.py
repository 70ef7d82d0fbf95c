"""Expected frames of an as-built lens on its bench, with derivatives by every
parameter, on coarse nodes.
"""

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from characterize.model import detector
from characterize.model.glass import BenchGeometry, FilmStack, source_paths
from characterize.model.kernel import real_of, wrapped_phasors
from characterize.model.parameters import PLACE
from characterize.model.pillars import (
    ChangeRange,
    PillarResponse,
    incidence_rad,
    of_lens,
    pillar_change_of,
)
from characterize.model.reduced import CompressedLens
from characterize.model.setting import (
    BENDING,
    LIGHT,
    AngleGroup,
    FrameSetting,
    SpectralLine,
    background_planes,
    brightness_slopes,
    light_maps,
    pixel_brightness,
    true_depth,
)
from characterize.model.window import WindowOperators
from metalens.core import threads
from metalens.core.arrays import Array
from metalens.fabrication import (
    CDError,
    ResponseError,
    Sensitivity,
    names_of_kind,
    of_kind,
)
from metalens.lens import Lens

GEOMETRY = (
    "distance_um", "wavelength_nm", "decentre_x_um", "decentre_y_um", "tilt_x_deg", "tilt_y_deg", "source_x_um",
    "source_y_um", "stage_zero_um", "stage_scale", "glass_um", "glass_tilt_x_deg", "glass_tilt_y_deg",
)  # fmt: skip
WIDENING, ANSWERING = (
    {name: n for n, name in enumerate(names_of_kind(kind))}
    for kind in (CDError, ResponseError)
)
EVERY = slice(None)
Light = tuple[Array, dict[str, Array]]  # and its derivatives by name
_SLOPE_TOLERANCE = (
    8e-3  # of derivatives: it slows the last steps of a fit, and moves nothing
)
_WINDOW = {
    "distance_um": ("distance", 1.0),
    "wavelength_nm": ("wave", 1e-3),
}  # what moves the window, um in its unit
_WAVE_STEP_NM, _WIDER_NM = 0.01, 0.02
_PITCH = PLACE["pixel_percent"]
# off the chief ray, within which windows need no more directions than those of the
# middle
_NEAR_UM = 5.0
_FEW, _FEWER = 2e-2, 0.85  # in a quick model: terms left out, and samples
# pixels around a part of a window: what blur brings from farther off changes little
_NARROW = 2


class ForwardModel:
    """Frames (n, rows, columns) in electrons as a function of
    :data:`parameters.PARAMETERS`.

    Accuracy: of the pillars ``Pillars.error`` in t, of the geometry
    ``setting.tolerance`` in the field; a test and the
    benchmark hold both against the sum over all pillars. ``cut``: what :meth:`rough`
    leaves out of it.
    """

    def __init__(
        self,
        lens: Lens,
        setting: FrameSetting,
        response: Sensitivity,
        *,
        span: ChangeRange | None = None,
    ) -> None:
        self.lens, self.setting, s = lens, setting, setting
        self.reference_um = float(
            2 / (1 / setting.depth_um.min() + 1 / setting.depth_um.max())
        )
        over, self._over = (
            detector.required_oversampling(lens, share * setting.pixel_um)
            for share in (1.0, _FEWER)
        )
        self.grid = detector.DetectorGrid(
            s.rows, s.columns, s.pixel_um, over, s.margin, fill=s.fill
        )
        self.response, self._span, self.cut, self._lean_um = response, span, 0.0, 0.0
        self.modes = np.empty(0)
        self._lit = EVERY, EVERY
        self._kept: dict[
            tuple[CompressedLens, Callable[[Array, Array, int], Array], int], Array
        ] = {}
        self._pillars: dict[float, PillarResponse] = {}
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
        """Of the frames at one field angle."""
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
                self.lens, self.response, span=self._span, angle_rad=incidence
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
        """The model of some of the frames, in rising order of their index; it shares
        all that was gathered.
        """
        part, s = copy.copy(self), self.setting
        part.setting = dataclasses.replace(
            s,
            depth_um=s.depth_um[frames],
            angle_rad=s.angle_rad[frames],
            exposure=s.exposure[frames],
        )
        part.groups = [
            one
            for one in (group.only(frames) for group in self.groups)
            if one is not None
        ]
        return part

    def about(self, middle_um: tuple[float, float]) -> "ForwardModel":
        """The same model with the window's middle held at (x, y) from the chief ray.

        Decentre beyond it acts as the phase that it gives the middle: k decentre X 1.5
        sin² / d is missed at X off it.
        """
        part = copy.copy(self)
        reach = max(
            _NEAR_UM, *(abs(v) + self.setting.pixel_um for v in self.grid.middle_um)
        )
        part.grid = dataclasses.replace(
            self.grid, middle_um=(float(middle_um[0]), float(middle_um[1]))
        )
        if max(abs(v) for v in middle_um) > reach:  # wants more directions
            part._kept, part.groups = (
                {},
                [part._group(a) for a in np.unique(self.setting.angle_rad, axis=0)],
            )
        return part

    def exchanged(self) -> "ForwardModel":
        """The same model of frames with rows and columns exchanged: those of a camera
        on its side.
        """
        part, s = copy.copy(self), self.setting
        part.setting = dataclasses.replace(s, rows=s.columns, columns=s.rows)
        part.grid = dataclasses.replace(self.grid, rows=s.columns, columns=s.rows)
        return part

    def rough(self, tolerance: float) -> "ForwardModel":
        """The same model with fields to a relative ``tolerance``: quick enough to scan
        with.
        """
        part = copy.copy(self)
        part.cut = tolerance
        return part

    def quick(self, rows: slice = EVERY, columns: slice = EVERY) -> "ForwardModel":
        """The same model by few terms of every field and on fewer samples: for
        differences to images of this one.

        rows, columns: of the window, where there is light enough to differ; its images
            are background alone beside it.
        """
        part, window_um = self.rough(_FEW), None
        part.grid, part._lit = self._sparser(), (rows, columns)
        narrow = part.grid.part(rows, columns, _NARROW)
        if narrow.rows < self.grid.rows or narrow.columns < self.grid.columns:
            part.grid, window_um = narrow, narrow.across_um(_NEAR_UM)
        part.groups = [group.quick(window_um) for group in self.groups]
        return part

    def _sparser(self) -> detector.DetectorGrid:
        """Samples for differences of images: of derivatives they miss less than a third
        of ``_SLOPE_TOLERANCE``.
        """
        return dataclasses.replace(self.grid, oversample=self._over)

    def with_pixel_pitch(self, ratio: float) -> "ForwardModel":
        """The same model with pixels ``ratio`` times as far apart and as wide."""
        part, pixel_um = copy.copy(self), self.setting.pixel_um * ratio
        part.setting = dataclasses.replace(self.setting, pixel_um=pixel_um)
        part.grid = dataclasses.replace(self.grid, pixel_um=pixel_um)
        return part

    def with_walls(self, angle_rad: float) -> "ForwardModel":
        """The same lens with side walls that lean by an angle about half height; its
        derivatives are those without.
        """
        part = copy.copy(self)
        part._lean_um = math.tan(angle_rad) * self.lens.cell.height_um
        return part

    def with_residual(
        self, modes: Array, basis: Callable[[Array, Array, int], Array]
    ) -> "ForwardModel":
        """The same lens with a phase of ``modes`` (m,) times ``basis`` (u, v, m) -> (m,
        *shape); see :mod:`thinplate`.

        Their derivatives are wanted as ``residual_0`` and so on.
        """
        part = copy.copy(self)
        part.modes = np.asarray(modes)
        if len(modes):
            part.groups = [
                g.bent(self._shapes(g, len(modes), basis)) for g in self.groups
            ]
        return part

    def _shapes(
        self, group: AngleGroup, count: int, basis: Callable[[Array, Array, int], Array]
    ) -> Array:
        """(count, q, p) of a basis on the nodes of a group; kept, since a search asks
        again for every step.
        """
        key = group.reduced, basis, count
        if key not in self._kept:
            self._kept[key] = basis(group.reduced.u, group.reduced.v, count)
        return self._kept[key]

    def images(
        self, x: Array, wanted: Sequence[str] | None = None
    ) -> tuple[Array, Array | None]:
        """Frames, and with ``wanted`` their derivatives by those parameters
        (len(wanted), n, rows, columns).
        """
        if x[_PITCH]:
            return self._off_pitch(x, wanted)
        light, slopes = self._light(x, wanted)
        s = self.setting
        films = self.films
        about = {"centre_um": self.stage_centre_um}
        scale = (
            pixel_brightness(
                x, s, reference_um=self.reference_um, films=films, **about
            )[:, None, None]
            / self.area_um2
        )
        sampled = scale * light
        if wanted is None:
            return sampled + background_planes(x, s), None
        out = np.zeros((len(wanted), *light.shape))
        plain: dict[str, Any] = {"background_e": s.glow, "log_gain": sampled}
        if "pixel_percent" in wanted:
            plain["pixel_percent"] = self._pitch_slope(x)
        plain |= {
            name: s.glow * edge
            for name, edge in zip(
                ("background_y_e", "background_x_e"), s.edges, strict=True
            )
        }
        for j, name in enumerate(wanted):
            out[j] = plain[name] if name in plain else scale * slopes[name]
        for name, rate in brightness_slopes(x, s, films=films, **about).items():
            if name in wanted:
                out[list(wanted).index(name)] += rate[:, None, None] * sampled
        return sampled + background_planes(x, s), out

    def _off_pitch(
        self, x: Array, wanted: Sequence[str] | None
    ) -> tuple[Array, Array | None]:
        """:meth:`images` where the pixel pitch is not the stated one."""
        ratio = 1 + float(x[_PITCH]) / 100
        stated = x.copy()
        stated[_PITCH] = 0.0
        frames, slopes = self.with_pixel_pitch(ratio).images(stated, wanted)
        if slopes is not None and wanted is not None and "pixel_percent" in wanted:
            slopes[list(wanted).index("pixel_percent")] /= ratio
        return frames, slopes

    def _pitch_slope(self, x: Array, step_percent: float = 0.3) -> Array:
        """(n, rows, columns) derivative by the pixel pitch per percent: central
        difference.
        """
        up, down = (
            self.with_pixel_pitch(1 + sign * step_percent / 100).images(x)[0]
            for sign in (1, -1)
        )
        return np.asarray((up - down) / (2 * step_percent))

    def _light(
        self, x: Array, wanted: Sequence[str] | None, like_nm: float | None = None
    ) -> Light:
        """(n, rows, columns) |E|² seen by the pixels, and its derivatives by name."""
        s = self.setting
        wanted = list(wanted or ())
        wide_nm = float(x[PLACE["bandwidth_nm"]])
        names = list(
            dict.fromkeys(
                "stage_zero_um" if name == "stage_scale" else name for name in wanted
            )
        )
        light = np.zeros((len(s.depth_um), s.rows, s.columns))
        slopes = {name: np.zeros_like(light) for name in names}
        for offset_nm, weight in self.spectrum.colours(wide_nm, like_nm):
            for group in (
                part for whole in self.groups for part in whole.illuminated_parts
            ):
                part, more = self._group_light(x, group, offset_nm, names)
                light[group.index, *self._lit] += weight * part
                for name in names:
                    if name in more:
                        slopes[name][group.index, *self._lit] += weight * more[name]
        if "bandwidth_nm" in names:
            up = x + _WIDER_NM * (np.arange(len(x)) == PLACE["bandwidth_nm"])
            slopes["bandwidth_nm"] = (
                self._light(up, None, wide_nm)[0] - light
            ) / _WIDER_NM
        if (
            "stage_scale" in wanted
        ):  # of one frame as its stage zero's, by how far it is from the middle
            slopes["stage_scale"] = (
                slopes["stage_zero_um"]
                * (s.depth_um - self.stage_centre_um)[:, None, None]
            )
        return light, slopes

    def _group_light(
        self, x: Array, group: AngleGroup, offset_nm: float, names: list[str]
    ) -> Light:
        x = x.copy()
        x[PLACE["wavelength_nm"]] += offset_nm
        operators, phasor, lens = threads.run_concurrently(
            lambda: self._operators(x, group),
            lambda: wrapped_phasors(self._phase(x, group), group.reduced.kind),
            lambda: self._pupil(x, group, bool(names)),
        )
        lit = lens[0] * phasor
        field = operators.envelope(operators.coarse(lit, self.cut))
        intensity = field.real**2 + field.imag**2
        transfer, blurs = self._transfer(x, group, names)
        light = self.grid.sample(intensity, transfer)
        conjugate, power = field.conj(), np.vdot(lit, lit).real
        rough, out = max(self.cut, _SLOPE_TOLERANCE), dict[str, Array]()
        for name in names:
            rate = self._lens_rate(x, group, name, lens, phasor)
            if rate is None:
                continue
            # the part of a change that is the light itself needs no sum, nor loses
            # digits
            same = np.vdot(lit, rate) / power
            rate = rate - same * lit
            seen = operators.envelope(operators.coarse(rate, rough))
            if name in _WINDOW:
                moves, um = _WINDOW[name]
                other = float(np.linalg.norm(rate)) / math.sqrt(power) / um
                seen = seen + um * operators.rates(lit, moves, rough, beside=other)
            out[name] = (
                self.grid.sample(2 * (conjugate * seen).real, transfer)
                + 2 * same.real * light
            )
        growth = self._growth(x, group) if x[PLACE["pinhole_um"]] > 0 else {}
        for name in growth.keys() & out.keys():  # the source's image grows too
            disc = (
                np.asarray(blurs["growth"])
                * (x[PLACE["pinhole_um"]] * growth[name])[:, None, None]
            )
            out[name] = out[name] + self.grid.sample(intensity, disc)
        for name in blurs.keys() & set(names):
            out[name] = self.grid.sample(intensity, blurs[name])
        return light, out

    def _lens_rate(
        self,
        x: Array,
        group: AngleGroup,
        name: str,
        lens: tuple[Array, Array, Array, Array],
        phasor: Array,
    ) -> Array | None:
        """(frames, q, p) derivative of the light on the nodes by one parameter, the
        window's own move left out; None where it changes none. ``lens``: of
        :meth:`_pupil`.
        """
        if name in WIDENING:
            rate = lens[1] * group.widening[WIDENING[name]] * phasor
        elif name in ANSWERING:
            rate = lens[2][ANSWERING[name]] * phasor
        elif (turning := group.turning(name)) is not None:
            rate = 1j * turning * lens[0] * phasor
        elif name in GEOMETRY:
            rate = self._phase_slope(x, group, name) * (lens[0] * phasor)
            if name == "wavelength_nm":
                rate = rate + lens[3] * phasor
        else:
            return None
        return np.asarray(rate.astype(phasor.dtype))

    def _pupil(
        self, x: Array, group: AngleGroup, slopes: bool
    ) -> tuple[Array, Array, Array, Array]:
        """(q, p) complex lens on the nodes, its derivative by the bias per um, by units
        of the answering causes, and by
        the wavelength per nm."""
        bias = np.tensordot([x[PLACE[name]] for name in WIDENING], group.widening, 1)
        reach = group.pillars.span.bias_um
        inside = np.abs(bias) < reach
        bias = np.clip(bias, -reach, reach).astype(real_of(group.reduced.kind))
        weight = group.pillars.weights(bias)
        values = group.pillars.coefficients(pillar_change_of(x), self._lean_um)
        pupil = group.reduced.combined(weight, values)
        if not slopes:
            return pupil, pupil, pupil, pupil
        rows = (row for _, row in of_kind(ResponseError))
        slopes_of = zip(group.pillars.slopes(pillar_change_of(x)), rows, strict=True)
        by = [group.reduced.combined(weight, c * row.unit) for c, row in slopes_of]
        up = x.copy()
        up[PLACE["wavelength_nm"]] += _WAVE_STEP_NM
        by_wave = (
            group.pillars.coefficients(pillar_change_of(up), self._lean_um) - values
        ) / _WAVE_STEP_NM
        rate = group.pillars.rates(bias, weight) * inside
        return (
            pupil,
            group.reduced.combined(rate, values),
            np.stack(by),
            group.reduced.combined(weight, by_wave),
        )

    def _phase(self, x: Array, group: AngleGroup) -> Array:
        """(frames, q, p) smooth phase on the nodes: bench geometry less what was taken
        off, aberrations; light.
        """
        reduced = group.reduced
        index = group.index
        nominal = group.reduced.bench
        here = reduced.x_um, reduced.y_um
        wavelength_um = nominal.wavelength_um + x[PLACE["wavelength_nm"]] * 1e-3
        k = 2 * math.pi / wavelength_um
        d = nominal.distance_um + x[PLACE["distance_um"]]
        lean = [math.tan(math.radians(x[PLACE[f"tilt_{a}_deg"]])) for a in "xy"]
        tx = nominal.tangents[0] + lean[0]
        ty = nominal.tangents[1] + lean[1]
        held = self.grid.middle_um
        chief = reduced.films.chief_um(d, (tx, ty))
        centre = (
            chief[0] + x[PLACE["decentre_x_um"]] - held[0],
            chief[1] + x[PLACE["decentre_y_um"]] - held[1],
        )
        films = FilmStack.of(self.lens.layers, wavelength_um)
        exit_path = films.sensor_path(*here, centre, d)
        depth = true_depth(x, self.setting, self.stage_centre_um)[index]
        out = source_paths(
            *here, depth_um=depth, tangents=(tx, ty), values=x, films=films
        )
        out += exit_path
        out *= k
        out -= reduced.known
        out += np.tensordot([x[PLACE[name]] for name in BENDING], group.bending, 1)
        uneven = x[[PLACE[name] for name in LIGHT]]
        light = (
            -0.5j * np.tensordot(uneven, light_maps(reduced.u, reduced.v), 1)
            if uneven.any()
            else 0.0
        )
        return (
            out
            + light
            + (np.tensordot(self.modes, group.residual, 1) if len(self.modes) else 0.0)
        )

    def _phase_slope(self, x: Array, group: AngleGroup, name: str) -> Array:
        """Derivative of i times :meth:`_phase` by a geometric parameter: central
        difference of a smooth function.
        """
        step = {"stage_zero_um": 0.5, "wavelength_nm": 1e-3}.get(name, 1e-2)
        way = step * (np.arange(len(x)) == PLACE[name])
        return 0.5j / step * (self._phase(x + way, group) - self._phase(x - way, group))

    def _operators(self, x: Array, group: AngleGroup) -> WindowOperators:
        nominal = group.reduced.bench
        return group.reduced.operators(
            wavelength_um=nominal.wavelength_um + x[PLACE["wavelength_nm"]] * 1e-3,
            distance_um=nominal.distance_um + x[PLACE["distance_um"]],
            axes_um=self.grid.axes_um(),
            edge_um=self.grid.margin * self.setting.pixel_um,
        )

    def _growth(self, x: Array, group: AngleGroup) -> dict[str, Array]:
        """(frames,) relative growth of the source's image with the parameters that
        change its magnification.
        """
        near, far = self._reduced(x, group)
        return {
            "distance_um": 1 / (self.films.filling * near),
            "stage_zero_um": -1 / far,
        }

    def _reduced(self, x: Array, group: AngleGroup) -> tuple[Array, Array]:
        """(frames,) distances to sensor and source in air that bend paraxial light as
        much.
        """
        far = self.films.apparent_um(
            true_depth(x, self.setting, self.stage_centre_um)[group.index]
        )
        return np.full(
            len(far),
            self.films.reduced_um(
                group.reduced.bench.distance_um + x[PLACE["distance_um"]]
            ),
        ), far

    def _transfer(
        self,
        x: Array,
        group: AngleGroup,
        names: list[str],
        grid: detector.DetectorGrid | None = None,
    ) -> tuple[detector.Blur, dict[str, detector.Blur]]:
        """Transfer of pixel, crosstalk and source disc, and its derivatives; see
        :func:`detector.transfers`.
        """
        near, far = self._reduced(x, group)
        shrink = near / far
        blur = x[PLACE["crosstalk_px"]]
        sizes = x[PLACE["pinhole_um"]] * shrink
        kind = real_of(group.reduced.kind)
        return detector.detector_transfers(
            grid or self.grid,
            blur,
            sizes,
            shrink,
            sized="pinhole_um" in names,
            kind=kind,
        )
