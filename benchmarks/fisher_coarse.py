"""The picture of a careless measure: what a climb claims when intensities are read
coarsely, and what the lens has.

python -m benchmarks.fisher_coarse           # docs/fisher/coarse.png, some seconds
"""

from pathlib import Path

import torch

from benchmarks.rivals.coarse_design import Claim, coarse_climb
from metalens.ground.report import canvas, png
from metalens.image.pupil import Pupil

ITERATIONS, LOOKS = 60, 20
PICTURE = Path(__file__).parents[1] / "docs" / "fisher" / "coarse.png"


def picture(found: Claim) -> bytes:
    """Claimed and honest information over the steps, on a logarithmic scale."""
    figure, panel = canvas(1, 1, size=(5.2, 3.4))
    every = ITERATIONS // LOOKS
    steps = [min(i * every, ITERATIONS - 1) for i in range(len(found.history))]
    panel.semilogy(
        steps,
        found.history[:, 0],
        "C1o-",
        ms=3,
        label="claimed: a sample every 3 µm, one position",
    )
    panel.semilogy(
        steps,
        found.history[:, 1],
        "C0o-",
        ms=3,
        label="honest: every 0.75 µm, nine positions",
    )
    panel.set(
        xlabel="step of the climb on the claim",
        ylabel="I(z) / mm⁻², mean over 16-26 mm",
    )
    panel.legend(fontsize=8)
    return png(figure)


if __name__ == "__main__":
    torch.set_num_threads(1)
    PICTURE.write_bytes(
        picture(coarse_climb(Pupil(nodes=160), iterations=ITERATIONS, looks=LOOKS))
    )
