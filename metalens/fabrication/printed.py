"""What a PROCESS.toml says of the made lens, for those who draw no mask: bias, spread,
and step of the diameters.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from metalens.core import config
from metalens.fabrication.bias import Bias, read_csv
from metalens.fabrication.spread import Spread

DIAMETER_STEP_NM = 2  # one class of pillars each


@dataclass(frozen=True, slots=True)
class Printed:
    """bias: of what is drawn. spread: of the process. diameter_step_nm: of the mask's
    pillars.
    """

    bias: Bias = field(default_factory=Bias)
    spread: Spread = field(default_factory=Spread)
    diameter_step_nm: float = DIAMETER_STEP_NM


def of_process(path: str | Path) -> Printed:
    """These entries of a PROCESS.toml; CSV files that it names lie beside it. The rest
    is left to ``layout``.

    Raises:
        ConfigError: missing file, not TOML, or a wrong entry, with file and key.
        ProcessError: a bias table that is unreadable or impossible.
    """
    path = Path(path)
    table = config.read(path, Printed)
    wanted: dict[str, Any] = {
        name: table[name] for name in ("bias", "spread") if name in table
    }
    rules = table.get("rules", {})
    if isinstance(rules, dict) and "diameter_step_nm" in rules:
        wanted["diameter_step_nm"] = rules["diameter_step_nm"]
    found = config.from_table(wanted, Printed, where=str(path))
    return dataclasses.replace(found, bias=with_table(found.bias, path.parent))


def with_table(bias: Bias, folder: str | Path) -> Bias:
    """``bias`` with the CSV file that it names read in from ``folder``."""
    if bias.csv is None:
        return bias
    return dataclasses.replace(
        bias, csv=None, table_nm=read_csv(Path(folder) / bias.csv)
    )
