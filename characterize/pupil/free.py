"""Optics that are known roughly only: aperture, index, pixel and step fitted with the
low orders of the pupil.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from characterize.inference import (
    FitImages,
    GaussianPrior,
    SolverSettings,
    leastsquares,
)
from characterize.pupil.record import FREE, PupilModel, PupilSpec
from metalens.core.arrays import Array

_REACH = 0.3  # of the logarithm of a factor
_STEP = 1e-3
_MOST_SINE = 0.98
Optics = tuple[tuple[str, float, float], ...]


def fit_free_settings(
    spec: PupilSpec,
    position_um: Array,
    data: FitImages,
    coarse: Callable[[PupilModel], Array],
    *,
    step_um: float,
) -> tuple[PupilSpec, Optics, float]:
    """What ``spec.free`` names, fitted: the specification with it, (name, value,
    sigma), true step over stated.

    Each is a factor to the stated value, known to the relative error of ``record.FREE``
    beforehand: where the images
    fix products only (aperture times pixel, say), that decides. Derivatives by the
    factors are differences of images.

    Args:
        position_um: (n,) stated stage positions, um.
        data: frames, masks and noise that are fitted.
        coarse: parameters of a model of few orders from which to start.
        step_um: stated mean step of the whole stack.
    """
    if not spec.free:
        return spec, (), 1.0
    images = _Images(spec, position_um)
    start = np.concatenate([coarse(images.model), np.zeros(len(spec.free))])
    p = len(start) - len(spec.free)
    wide = np.full(len(start), np.inf)
    off, mean = images.model.layout().off, start.copy()
    wide[off], mean[off] = images.model.stage_sigma_um, 0.0
    wide[p - 2 * len(position_um) : p - len(position_um)] = 0.3  # gains
    wide[p:] = [FREE[name] for name in spec.free]
    low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    low[p:], high[p:] = -_REACH, _REACH
    blur = p - 2 * len(position_um) - 1
    low[blur], high[blur] = 0.05 * spec.pixel_um, 4 * spec.pixel_um
    settings = SolverSettings(iterations=40, step_tolerance=0.1, near=1.0, secant=True)
    prior = GaussianPrior(mean, wide, low, high)
    found = leastsquares.fit_levenberg_marquardt(
        images, data, start, prior=prior, settings=settings
    )
    made, position = images.optics(found.value[p:])
    spread = np.sqrt(np.diag(found.covariance)[p:] * max(1.0, found.chi2_per_dof))
    longer = float(np.ptp(position) / np.ptp(position_um))
    value = [
        longer * step_um if name == "step_um" else float(getattr(made, name))
        for name in spec.free
    ]
    optics = tuple(
        (n, v, float(v * s)) for n, v, s in zip(spec.free, value, spread, strict=True)
    )
    return made, optics, longer


class _Images:
    """Images by the parameters of a pupil and the logarithms of the factors; the pupil
    is sampled alike for all.

    So is the kind of the model: one that turned vectorial at some aperture on the way
    would jump there.
    """

    def __init__(self, spec: PupilSpec, position_um: Array) -> None:
        widest = dataclasses.replace(
            spec,
            numerical_aperture=min(1.2 * spec.numerical_aperture, 0.97 * spec.index),
        )
        kind: Literal["vector", "scalar"] = "vector" if widest.vectorial else "scalar"
        self.spec, self.position_um = dataclasses.replace(spec, model=kind), position_um
        self.orders = {
            "phase_order": min(spec.phase_order, 6),
            "amplitude_order": min(spec.amplitude_order, 2),
        }
        self.nodes = PupilModel(widest, 1.1 * position_um, **self.orders).nodes
        self.model = self._at(np.zeros(len(spec.free)))

    def optics(self, logs: Sequence[float] | Array) -> tuple[PupilSpec, Array]:
        """Specification and positions for logarithms of the factors."""
        factor = dict(zip(self.spec.free, np.exp(logs).tolist(), strict=True))
        position = self.position_um * factor.pop("step_um", 1.0)
        values = {
            name: getattr(self.spec, name) * size for name, size in factor.items()
        }
        index = max(values.get("index", self.spec.index), 1.0)
        aperture = min(
            values.get("numerical_aperture", self.spec.numerical_aperture),
            _MOST_SINE * index,
        )
        return dataclasses.replace(
            self.spec, **(values | {"index": index, "numerical_aperture": aperture})
        ), position

    def _at(self, logs: Array) -> PupilModel:
        spec, position = self.optics(logs)
        return PupilModel(spec, position, nodes=self.nodes, **self.orders)

    def __call__(self, x: Array, jacobian: bool) -> tuple[Array, Array | None]:
        """Images and, where wanted, their derivatives by all."""
        k = len(self.spec.free)
        image, slopes = self._at(x[-k:]).images(x[:-k], jacobian)
        if slopes is None:
            return image, None
        more = []
        for step in _STEP * np.eye(k):
            up, down = (
                self._at(x[-k:] + sign * step).images(x[:-k], False)[0]
                for sign in (1, -1)
            )
            more.append((up - down) / (2 * _STEP))
        return image, np.concatenate([slopes, np.array(more)])


def freed_text(spec: PupilSpec, found: Optics) -> list[str]:
    """What was freed beside what was stated, in words.

    Args:
        spec: what is known of optics and stage.
        found: fitted optics.
    """
    words = []
    for name, value, sigma in found:
        before = getattr(spec, name)
        given = f", stated {before:.4g}" if math.isfinite(before) else ""
        words.append(f"{name} = {value:.4g} +- {sigma:.2g} was fitted{given}")
    return words
