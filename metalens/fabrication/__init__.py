"""Process variation: one table of fabrication perturbations with their derivatives,
states of them, their spread, and the bias of a mask.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.fabrication import perturbations as perturbations
    from metalens.fabrication import spread as spread
    from metalens.fabrication.bias import STEEPEST as STEEPEST
    from metalens.fabrication.bias import Bias as Bias
    from metalens.fabrication.bias import read_csv as read_csv
    from metalens.fabrication.own import OwnRates as OwnRates
    from metalens.fabrication.own import own_rates as own_rates
    from metalens.fabrication.own import pair_rates as pair_rates
    from metalens.fabrication.perturbations import PERTURBATIONS as PERTURBATIONS
    from metalens.fabrication.perturbations import CDError as CDError
    from metalens.fabrication.perturbations import Drawn as Drawn
    from metalens.fabrication.perturbations import Guide as Guide
    from metalens.fabrication.perturbations import Perturbation as Perturbation
    from metalens.fabrication.perturbations import ResponseError as ResponseError
    from metalens.fabrication.perturbations import WavefrontError as WavefrontError
    from metalens.fabrication.perturbations import coarser as coarser
    from metalens.fabrication.perturbations import lacking as lacking
    from metalens.fabrication.perturbations import larger as larger
    from metalens.fabrication.perturbations import maps as maps
    from metalens.fabrication.perturbations import named as named
    from metalens.fabrication.perturbations import of_kind as of_kind
    from metalens.fabrication.perturbations import with_missing as with_missing
    from metalens.fabrication.printed import Printed as Printed
    from metalens.fabrication.printed import of_process as of_process
    from metalens.fabrication.printed import with_table as with_table
    from metalens.fabrication.response import Answer as Answer
    from metalens.fabrication.response import Sensitivity as Sensitivity
    from metalens.fabrication.response import Slopes as Slopes
    from metalens.fabrication.response import answer as answer
    from metalens.fabrication.response import biased as biased
    from metalens.fabrication.response import designed as designed
    from metalens.fabrication.response import guide as guide
    from metalens.fabrication.response import sensitivity as sensitivity
    from metalens.fabrication.response import transmission as transmission
    from metalens.fabrication.solved import Solved as Solved
    from metalens.fabrication.spread import DRAWN as DRAWN
    from metalens.fabrication.spread import Draw as Draw
    from metalens.fabrication.spread import Spread as Spread
    from metalens.fabrication.spread import draws as draws
    from metalens.fabrication.state import State as State
    from metalens.fabrication.two_sizes import Kinds as Kinds
    from metalens.fabrication.two_sizes import PairSensitivities as PairSensitivities
    from metalens.fabrication.two_sizes import PairTable as PairTable
    from metalens.fabrication.two_sizes import pair_sensitivities as pair_sensitivities

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Answer": "response",
        "ResponseError": "perturbations",
        "WavefrontError": "perturbations",
        "Bias": "bias",
        "PERTURBATIONS": "perturbations",
        "Perturbation": "perturbations",
        "DRAWN": "spread",
        "Draw": "spread",
        "Drawn": "perturbations",
        "Guide": "perturbations",
        "Kinds": "two_sizes",
        "OwnRates": "own",
        "PairSensitivities": "two_sizes",
        "PairTable": "two_sizes",
        "Printed": "printed",
        "STEEPEST": "bias",
        "Sensitivity": "response",
        "Slopes": "response",
        "Solved": "solved",
        "Spread": "spread",
        "State": "state",
        "CDError": "perturbations",
        "answer": "response",
        "biased": "response",
        "perturbations": "",
        "coarser": "perturbations",
        "designed": "response",
        "draws": "spread",
        "guide": "response",
        "lacking": "perturbations",
        "larger": "perturbations",
        "maps": "perturbations",
        "named": "perturbations",
        "of_kind": "perturbations",
        "of_process": "printed",
        "own_rates": "own",
        "pair_rates": "own",
        "pair_sensitivities": "two_sizes",
        "read_csv": "bias",
        "sensitivity": "response",
        "spread": "",
        "transmission": "response",
        "with_missing": "perturbations",
        "with_table": "printed",
    },
)
