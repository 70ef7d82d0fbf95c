"""Causes that the fit leaves out: each leans the residuals its own way, and is looked for along that (score test).

With residuals r over their noise at the mode, the fitted slopes A (priors included) and the change of the images by
a cause G, both over the noise, what the fit cannot make up for is G' = G - A (AᵀA)⁻¹ AᵀG. Then s = Gᵀr scatters with
covariance I = GᵀG' where the cause is absent, and sᵀI⁻¹s follows chi-square of as many degrees (Rao 1948). One number
for each cause: more telling than the chi-square of all pixels, in which a twentieth of a sigma a pixel drowns.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, stats

from characterize.inference.leastsquares import Solution
from characterize.inference.search import Task
from characterize.model import MODES, PLACE, Setting, basis, prior_rad
from metalens.ground.arrays import Array
from metalens.ground.errors import FitError
from metalens.lens import Lens

CHANCE = 1e-4  # of one cause to be spoken of where there is none: one fit in 500 with them all
_SEEN = 4.0  # sigma of what the fit leaves of a cause, above which it would be found
_STITCH_UM = 0.05
_WALL_DEG = 1.5
_SHIFTS, _NEAREST_PX, _FARTHEST_PX = 400, 3, 14  # of a ghost

_TILTED = {"glass_um": 100.0, "glass_tilt_x_deg": 0.0, "glass_tilt_y_deg": 0.0}
_OF_MODEL: tuple[tuple[str, dict[str, float], str, float], ...] = (  # cause, from, name and amount that is added
    ("a source of finite size", {}, "pinhole_um", 6),
    ("a spectrum of finite width", {}, "bandwidth_nm", 2),
    ("a tilt of the lens about y", {}, "tilt_x_deg", 0.3),
    ("a tilt of the lens about x", {}, "tilt_y_deg", 0.3),
    ("a saddle of the diameters", {}, "bias_a_nm", 3),
    ("an oblique saddle of the diameters", {}, "bias_o_nm", 3),
    ("a tilted side wall", {}, "sidewall_deg", 0.5),
    ("another refractive index", {}, "index", 0.01),
    ("a plate of glass in the beam", {}, "glass_um", 100),
    ("a tilt of 100 um of glass about y", _TILTED, "glass_tilt_x_deg", 5),
    ("a tilt of 100 um of glass about x", _TILTED, "glass_tilt_y_deg", 5),
)


@dataclass(frozen=True, slots=True)
class Lean:
    """One cause: its words, chi-square by which the residuals lean along it, its degrees, and the chance of that.

    taken: what takes it up, in words, where the fit cannot tell it from what is fitted; empty where it can.
    """

    cause: str
    chi2: float
    degrees: int
    chance: float
    taken: str = ""


def leans(task: Task, mode: Solution) -> list[Lean]:
    """Every cause that is not fitted and can be told apart from what is, the most telling first."""
    model, x = task.model, task.all_of(mode.value)
    image, slopes = model.images(x, task.names)
    root = np.where(task.data.usable & ~task.data.saturated, 1 / np.sqrt(task.data.variance(image)), 0.0)
    rest = (np.clip(mode.residual_sigma, -6, 6) * (root > 0)).ravel()
    fitted = (np.asarray(slopes) * root).reshape(len(task.names), -1)
    known = fitted @ fitted.T + np.diag(task.prior.sigma**-2.0)
    spread = max(1.0, mode.chi2_per_dof)
    fit = Fitted(task.names, fitted, known, rest / math.sqrt(spread), task.data.shared(image) * root)
    found = []
    for cause, amount, told, changes in _changes(
        task, x, image, dict(zip(task.names, np.asarray(slopes), strict=True))
    ):
        change = (changes * root).reshape(len(changes), -1)
        taken = fit.taken(change[0], amount, told) if told else ""
        found.append(dataclasses.replace(fit.lean(cause, change), taken=taken))
    found.append(_ghost(task, x, image, root, fit))
    return sorted((one for one in found if one.degrees or one.taken), key=lambda one: one.chance)


def words(found: list[Lean]) -> list[str]:
    """The cause that the residuals lean to most, with those that are as likely; nothing where all is chance."""
    told = [one for one in found if one.chance < CHANCE]
    if not told:
        return []
    first = told[0]
    alike = [one.cause for one in told[1:4]]
    more = f"; {', '.join(alike)} would explain much of it too" if alike else ""
    return [
        f"residuals lean towards {first.cause}, which is not fitted (chi-square {first.chi2:.0f} with {first.degrees} "
        f"of them){more}: intervals hold only if it is absent; state it, free it, or mend the bench"
    ]


def untold(found: list[Lean]) -> list[str]:
    """Causes that are not fitted and cannot be told from what is, with what they would be taken for."""
    return [f"{one.cause} is not fitted: {one.taken}" for one in found if one.taken]


@dataclass(frozen=True, eq=False, slots=True)
class Fitted:
    """The fit at its mode: slopes (p, pixels) over the noise, their information with the priors, and the residuals.

    shared: (2, n, y, x) errors of dark and of flat that are one in all frames, over the noise.
    """

    names: tuple[str, ...]
    slopes: Array
    known: Array
    rest: Array
    shared: Array

    def lean(self, cause: str, changes: Array) -> Lean:
        """Score test of (k, pixels) changes; directions of which the fit takes up all but a thousandth are left out."""
        size = np.sqrt((changes**2).sum(1))
        changes = changes[size > 0] / size[size > 0, None]
        if not len(changes):
            return Lean(cause, 0.0, 0, 1.0)
        left, score = self.left(changes)
        values, vectors = np.linalg.eigh(changes @ left.T)
        vectors = vectors[:, values > 1e-3]
        degrees = vectors.shape[1]
        if not degrees:
            return Lean(cause, 0.0, 0, 1.0)
        scatter = vectors.T @ (changes @ left.T + self.in_common(left)) @ vectors
        chi2 = float(score @ vectors @ np.linalg.solve(scatter, vectors.T @ score))
        return Lean(cause, chi2, degrees, float(stats.chi2.sf(chi2, degrees)))

    def left(self, changes: Array) -> tuple[Array, Array]:
        """(k, pixels) what the fit does not take up of changes, and (k,) how much of it is in the residuals."""
        left = changes - np.linalg.solve(self.known, self.slopes @ changes.T).T @ self.slopes
        return left, left @ self.rest

    def in_common(self, left: Array) -> Array:
        """(k, k) by which scores scatter more since errors of dark and flat are one in all frames."""
        shape = self.shared.shape[1:]
        dark, flat = ((left.reshape(-1, *shape) * one).sum(1).reshape(len(left), -1) for one in self.shared)
        counted = left * self.shared[0].ravel()
        return np.asarray(dark @ dark.T + flat @ flat.T - counted @ counted.T)

    def taken(self, change: Array, amount: float, told: str) -> str:
        """What the parameters would do with a change of the images; empty where it does nothing.

        Of ``amount``, or as much of it as would not be seen: of what they leave ``_SEEN`` sigma or less. Nothing: no
        parameter moves by one sigma. ``told``: the cause's amount in words, with a place for the number.
        """
        moved = np.linalg.solve(self.known, self.slopes @ change)
        left = math.sqrt(max(float(change @ change - (self.slopes @ change) @ moved), 0.0))
        share = min(1.0, _SEEN / max(left, 1e-12))
        step = share * moved / np.sqrt(np.diag(np.linalg.inv(self.known)))
        most = [i for i in np.argsort(-np.abs(step))[:3] if abs(step[i]) > 1]
        parts = ", ".join(f"{self.names[i]} {share * moved[i]:+.2g} ({abs(step[i]):.1f} sigma)" for i in most)
        return f"{told.format(share * amount)} would be taken for {parts}; state it if there is any" if most else ""


def _changes(task: Task, x: Array, image: Array, slopes: dict[str, Array]) -> Iterator[tuple[str, float, str, Array]]:
    """(cause, amount and its words where it is one, (k, n, y, x) changes of the images by it)."""
    model, n = task.model, len(image)
    for cause, base, name, amount in _OF_MODEL:
        if name not in task.names and all(key == name or x[PLACE[key]] == 0 for key in base):
            before, after = x.copy(), x.copy()
            for key, value in base.items():
                before[PLACE[key]] = after[PLACE[key]] = value
            after[PLACE[name]] += amount
            with contextlib.suppress(FitError):  # a spectrum wider than the proxy knows, a plate with no room
                first = model.images(before)[0] if base else image
                yield cause, amount, name + " {:.3g}", (model.images(after)[0] - first)[None]
    leaning = model.with_walls(math.radians(_WALL_DEG)).images(x)[0] - image
    if "sidewall_deg" not in task.names:
        told = "an angle whose square is {:.3g} deg²"
        yield "a side wall that leans about half height", _WALL_DEG**2, told, leaning[None]
    for along, name in enumerate(("x", "y")):
        shape = _field_off(model.lens, along)
        moved = model.with_residual(np.array([_STITCH_UM]), shape).images(x)[0] - image
        if not len(model.modes):
            yield f"a write field off along {name}", _STITCH_UM * 1e3, "{:.3g} nm of the right half", moved[None]
    if n > 2:
        light = image - _background(x, model.setting)
        yield "a lamp or exposure that changes from frame to frame", 0.0, "", _each(light)
        yield "shifts from frame to frame", 0.0, "", np.concatenate([_each(np.gradient(light, axis=a)) for a in (1, 2)])
        yield "vibration or blur in single frames", 0.0, "", _each(_curvature(light))
        yield "a stage error in single frames", 0.0, "", _each(slopes["stage_zero_um"])
        if "wavelength_nm" in slopes:
            ramp = np.linspace(-1, 1, n)[:, None, None]
            yield "a wavelength that drifts", 0.0, "", (slopes["wavelength_nm"] * ramp)[None]
    stretched = _stretched(image - _background(x, model.setting))
    yield "a wrong pixel pitch", 1.0, "{:.3g} % of the pitch", 0.01 * stretched[None]
    if not len(model.modes):
        step = 0.05
        uneven = [model.with_residual(-1j * step * np.eye(5)[i], _low_orders).images(x)[0] - image for i in range(5)]
        yield "uneven illumination", 10.0, "{:.3g} % more light at the right rim", np.array(uneven)
        names = [f"residual_{k}" for k in range(MODES)]
        bent = model.with_residual(np.zeros(MODES), basis).images(x, names)[1]
        yield "a smooth phase that no parameter describes", 0.0, "", np.asarray(bent) * prior_rad()[:, None, None, None]


def _field_off(lens: Lens, along: int) -> Callable[[Array, Array, int], Array]:
    """Phase for 1 um by which the pillars right of the axis are moved along x (0) or y (1): that of the focus there."""
    k, radius, d = 2 * math.pi / lens.wavelength_um, lens.diameters.radius_um, lens.sensor_distance_um

    def phase(u: Array, v: Array, count: int) -> Array:
        r = radius * np.hypot(u, v)
        sine = 1 / np.hypot(r, d) + (1 / np.hypot(r, lens.source_distance_um) if lens.source_distance_um > 0 else 0.0)
        return np.asarray((k * radius * (u, v)[along] * sine * (u > 0))[None])

    return phase


def _ghost(task: Task, x: Array, image: Array, root: Array, fit: Fitted) -> Lean:
    """The shift of the light at which a fainter copy of it explains most; its chance is that of the best of many."""
    light = image - _background(x, task.model.setting)
    reach = min(_FARTHEST_PX, min(light.shape[1:]) // 2 - 1)
    places = [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1)]
    places = [p for p in places if max(abs(p[0]), abs(p[1])) >= _NEAREST_PX]
    places = places[:: math.ceil(len(places) / _SHIFTS)] if places else []
    best = 0.0
    for shift in places:
        copy = (_moved(light, shift) * root).reshape(1, -1)
        left, score = fit.left(copy)
        seen = float((copy * left).sum())
        if seen > 1e-3 * float((copy**2).sum()) and score[0] > 0:
            best = max(best, float(score[0]) ** 2 / (seen + float(fit.in_common(left)[0, 0])))
    chance = min(1.0, len(places) * float(stats.chi2.sf(best, 1)) / 2)
    return Lean("a ghost: a fainter, shifted copy of the light", best, int(bool(places)), chance)


def _moved(light: Array, shift: tuple[int, int]) -> Array:
    """Shifted by whole pixels, nothing coming in from outside."""
    out = np.zeros_like(light)
    rows, columns = light.shape[1:]
    dy, dx = shift
    out[:, max(dy, 0) : rows + min(dy, 0), max(dx, 0) : columns + min(dx, 0)] = light[
        :, max(-dy, 0) : rows - max(dy, 0), max(-dx, 0) : columns - max(dx, 0)
    ]
    return out


def _each(change: Array) -> Array:
    """(n, n, y, x): every frame's change alone."""
    out = np.zeros((len(change), *change.shape))
    out[np.arange(len(change)), np.arange(len(change))] = change
    return out


def _curvature(light: Array) -> Array:
    return np.stack([ndimage.laplace(frame, mode="nearest") for frame in light])


def _stretched(light: Array) -> Array:
    """r dI/dr about the window's centre: the images on pixels of another pitch."""
    rows, columns = light.shape[1:]
    y, x = (np.arange(rows) - rows // 2)[:, None], (np.arange(columns) - columns // 2)[None]
    return np.asarray(np.gradient(light, axis=1) * y + np.gradient(light, axis=2) * x)


def _low_orders(u: Array, v: Array, count: int) -> Array:
    """u, v, u², v², uv: illumination that leans, or falls off to the rim."""
    return np.stack([u, v, u * u, v * v, u * v][:count])


def _background(x: Array, setting: Setting) -> Array:
    rows, columns = setting.rows, setting.columns
    edge_y = (np.arange(rows) - rows // 2)[:, None] / (rows / 2)
    edge_x = (np.arange(columns) - columns // 2)[None] / (columns / 2)
    along = x[PLACE["background_x_e"]] * edge_x + x[PLACE["background_y_e"]] * edge_y
    return np.asarray(x[PLACE["background_e"]] + along)
