"""Published intervals hang on the priors: ``tests/priors.txt`` lists, of every parameter
of lens and bench, start, sigma, bounds, what is unstated and the step.
"""

from pathlib import Path

from characterize.model.parameters import PARAMETERS, UNFITTED


def test_priors_are_the_published_ones():
    here = [
        f"{p.name}: {p.start:g} +- {p.sigma:g} within {p.low:g} to {p.high:g}, "
        f"{'fitted' if p.free else 'held'}, unstated {p.unstated:g}, scale {p.scale:g}"
        for p in PARAMETERS
    ]
    here += [f"{row.name}: 0 +- {row.sigma:g}, never fitted" for row in UNFITTED]
    listed = (Path(__file__).parent / "priors.txt").read_text(encoding="utf-8")
    assert here == listed.splitlines()
