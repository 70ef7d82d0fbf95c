"""The exposure verified: what the written files and their dose table make.

Shared with the correction: the Gaussians of the process file and the threshold of half
of a wide area. Its own: shapes and doses as read back, the sums over neighbours, the
background on pixels, the edges.

See :mod:`layout.certify.exposed` for the model. Of marks, labels and any other shape
the edges are sampled.
"""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from layout.certify import outlines
from layout.certify.exposed import THRESHOLD, WIDE_UM, Band, Simulation, Terms
from layout.certify.gathered import Exposed, Polygons, on_lattices
from layout.certify.verdict import Edges, Survey, Tally
from layout.files import MaskContent
from layout.mask import MaskPlan
from layout.process import LayerNumber, Process
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm


def survey(
    content: MaskContent,
    plan: MaskPlan,
    doses: Mapping[LayerNumber, float],
    process: Process,
    *,
    height_um: float = 0.0,
    keep: Callable[[Band, Array], None] | None = None,
) -> Survey:
    """Simulate the exposure of a mask that was read back, whose pillars stand exactly
    where ``plan`` has them.

    Args:
        content: read back; sums over its placements, that agree with the plan, are
            enough.
        doses: its dose table. height_um: of the pillars, for their feet.
        keep: is given each band of pillars, at their sites, with the (n,) layer numbers
            of its pillars; memory is
            bounded.

    Accuracy: backscatter to 1e-3 of itself (pixels of a quarter of its range), edges to
    0.01 nm. Edges are sampled
    away from corners, which round off.

    Raises:
        ProcessError: no double or triple Gaussian is given, no pillar has a dose, or a
            class is not one outline.
    """
    terms = _terms(process)
    scene = on_lattices(content, plan, doses, _fixed(process))
    layer = scene.kinds.layer

    def some(band: Band) -> None:
        if keep is not None:
            aside = scene.places.centre_um[band.kind]
            at_site = dataclasses.replace(
                band, x_um=band.x_um - aside[:, 0], y_um=band.y_um - aside[:, 1]
            )
            keep(at_site, layer[band.kind])

    return _surveyed(scene, process, terms, height_um, some)


def _fixed(process: Process) -> tuple[int, ...]:
    """Layer numbers that the exposure of the pillars does not see."""
    return (
        process.layers.aperture[0],
        process.layers.outline[0],
        process.layers.fields[0],
    )


def _judged(scene: Exposed, process: Process) -> Array:
    """(kinds,) false for the dose test."""
    return np.asarray(scene.kinds.layer != process.layers.dose[0])


def _terms(process: Process) -> Terms:
    """(range, weight) of the Gaussians, weights of sum 1."""
    e = process.exposure
    if e.alpha_um is None or e.beta_um is None or e.eta is None:
        raise ProcessError(
            f"the exposure cannot be certified: [exposure] needs {e.missing}"
        )
    found = [(e.alpha_um, 1.0), (e.beta_um, e.eta)] + (
        [] if e.gamma_um is None else [(e.gamma_um, e.nu)]
    )
    total = sum(weight for _, weight in found)
    return [(range_um, weight / total) for range_um, weight in found]


def _surveyed(
    scene: Exposed,
    process: Process,
    terms: Terms,
    height_um: float,
    keep: Callable[[Band], None],
) -> Survey:
    """Simulate all bands; ``keep`` sees each."""
    points = outlines.samples(
        scene.others, max((a for a, _ in terms if a < WIDE_UM), default=0.0)
    )
    simulation = Simulation(scene, process, terms, points.at_um)
    total, box, judged = Tally.empty(), scene.places.box_um, _judged(scene, process)
    drawn = (scene.kinds.drawn_um / nm).astype(np.float32)
    for band in simulation.bands():
        values = (band.exposure, drawn[band.kind], band.resist_nm, band.made_nm)
        total.take((band.x_um, band.y_um), judged[band.kind], values, box)
        keep(band)
    top, foot = process.top_foot_nm(0.0, height_um / nm)
    edges = _edges(points, scene.others, simulation.far_of_points, terms)
    return Survey(
        scene.places.count,
        total,
        box,
        edges,
        float(foot - top) / 2,
        process.exposure.tolerance,
        scene.undosed,
    )


def _edges(
    points: outlines.Samples, others: Polygons, far: Array, terms: Terms
) -> Edges:
    """Exposure at the samples, and where across each edge it is the threshold."""
    near = [(a, w) for a, w in terms if a < WIDE_UM]
    every = np.concatenate([points.at_um, *outlines.slope_aside(points)])
    here, outside, inside = np.split(outlines.exposure(every, others, near), 3)
    here = here + far
    slope = np.maximum(inside - outside, 1e-12) / outlines.aside_um()
    x, y = points.at_um.T
    return Edges(x, y, here / THRESHOLD, (here - THRESHOLD) / slope / nm, points.layer)
