"""Words that the options of a run offer."""

from typing import Literal

Part = Literal["optics", "pitch", "architecture"]
Place = Literal["auto", "cpu", "cuda"]
