"""The made lens: one table of causes with their derivatives, states of them, their
spread, and the bias of a mask.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.made import causes as causes
    from metalens.made import spread as spread
    from metalens.made.bias import STEEPEST as STEEPEST
    from metalens.made.bias import Bias as Bias
    from metalens.made.bias import read_csv as read_csv
    from metalens.made.causes import CAUSES as CAUSES
    from metalens.made.causes import Answers as Answers
    from metalens.made.causes import Bends as Bends
    from metalens.made.causes import Cause as Cause
    from metalens.made.causes import Drawn as Drawn
    from metalens.made.causes import Guide as Guide
    from metalens.made.causes import Widens as Widens
    from metalens.made.causes import coarser as coarser
    from metalens.made.causes import lacking as lacking
    from metalens.made.causes import larger as larger
    from metalens.made.causes import maps as maps
    from metalens.made.causes import named as named
    from metalens.made.causes import of_kind as of_kind
    from metalens.made.causes import with_missing as with_missing
    from metalens.made.own import OwnRates as OwnRates
    from metalens.made.own import own_rates as own_rates
    from metalens.made.own import pair_rates as pair_rates
    from metalens.made.printed import Printed as Printed
    from metalens.made.printed import of_process as of_process
    from metalens.made.printed import with_table as with_table
    from metalens.made.response import Answer as Answer
    from metalens.made.response import Sensitivity as Sensitivity
    from metalens.made.response import Slopes as Slopes
    from metalens.made.response import answer as answer
    from metalens.made.response import biased as biased
    from metalens.made.response import designed as designed
    from metalens.made.response import guide as guide
    from metalens.made.response import sensitivity as sensitivity
    from metalens.made.response import transmission as transmission
    from metalens.made.solved import Solved as Solved
    from metalens.made.spread import DRAWN as DRAWN
    from metalens.made.spread import Draw as Draw
    from metalens.made.spread import Spread as Spread
    from metalens.made.spread import draws as draws
    from metalens.made.state import State as State
    from metalens.made.two_sizes import Kinds as Kinds
    from metalens.made.two_sizes import PairSensitivities as PairSensitivities
    from metalens.made.two_sizes import PairTable as PairTable
    from metalens.made.two_sizes import pair_sensitivities as pair_sensitivities

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Answer": "response",
        "Answers": "causes",
        "Bends": "causes",
        "Bias": "bias",
        "CAUSES": "causes",
        "Cause": "causes",
        "DRAWN": "spread",
        "Draw": "spread",
        "Drawn": "causes",
        "Guide": "causes",
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
        "Widens": "causes",
        "answer": "response",
        "biased": "response",
        "causes": "",
        "coarser": "causes",
        "designed": "response",
        "draws": "spread",
        "guide": "response",
        "lacking": "causes",
        "larger": "causes",
        "maps": "causes",
        "named": "causes",
        "of_kind": "causes",
        "of_process": "printed",
        "own_rates": "own",
        "pair_rates": "own",
        "pair_sensitivities": "two_sizes",
        "read_csv": "bias",
        "sensitivity": "response",
        "spread": "",
        "transmission": "response",
        "with_missing": "causes",
        "with_table": "printed",
    },
)
