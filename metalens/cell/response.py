"""What every solver of a pillar cell returns."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Response:
    """Zero-order response of one pillar cell, power-normalised: |t|² + |r|² = 1 without
    absorption where no other order propagates (see ``other_orders``).

    The phase runs from the plane of the pillar's foot to the plane of its top;
    incidence from the substrate;
    time factor exp(-iwt). For films under or over the pillar the planes are the outer
    faces of the films.

    t, r: co-polarised transmission and reflection amplitudes.
    t_error: estimate of the larger of |t - exact| and |r - exact|, not below it.
    orders: harmonics (RCWA) or degrees of freedom (modal) of the finest solution used.
    energy: |t|² + |r|² summed over the propagating orders; 1 - energy is absorbed (or a
    defect if lossless). In a
        substrate that absorbs, powers of light that comes and that is reflected do not
        add, and it may exceed 1.
    engine: ``rcwa``, ``modal`` or ``film``.
    converged: whether ``t_error`` meets the requested tolerance.
    reason: why the solver stopped, in words.
    """

    t: complex
    r: complex
    t_error: float
    orders: int
    energy: float
    engine: str
    converged: bool
    reason: str

    @property
    def other_orders(self) -> float:
        """Share of the incident power that leaves in orders other than zero.

        Shapes without a mirror along x or y: with what leaves in the zero order of the
        other polarisation. Accuracy: that of |t|² + |r|², 4 ``t_error`` at most.
        """
        return max(0.0, self.energy - abs(self.t) ** 2 - abs(self.r) ** 2)
