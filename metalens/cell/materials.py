"""Refractive index of materials, exp(-iwt): published ones, own CSV or YAML files
(:mod:`metalens.cell.dispersion`), plain numbers. Nothing is extrapolated.
"""

import cmath
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from metalens.cell import record
from metalens.cell.dispersion import (
    Dispersion,
    DispersionFormula,
    parse_csv,
    parse_page,
)
from metalens.cell.record import Blend, Index
from metalens.core import reading
from metalens.core.errors import MaterialError, nearest_name_hint


@dataclass(frozen=True, eq=False, slots=True)
class Material:
    """Optical constants of one material.

    name, source: what it is, and where the numbers come from.
    n, k: of a wavelength; k None: transparent.
    """

    name: str
    source: str
    n: Dispersion
    k: Dispersion | None = None

    def __post_init__(self) -> None:
        low, high = self.range_um
        if low >= high:
            raise MaterialError(
                f"{self.name}: n holds from {self.n.range_um[0]:g} to "
                f"{self.n.range_um[1]:g} um, and k at no wavelength of these"
            )

    @property
    def range_um(self) -> tuple[float, float]:
        """Shortest and longest vacuum wavelength for which the numbers hold."""
        ranges = [part.range_um for part in (self.n, self.k) if part is not None]
        return max(low for low, _ in ranges), min(high for _, high in ranges)


_DATA = Path(__file__).parent.parent / "data"
_TABLES = {"a-Si": "a-Si.csv", "Si": "Si.csv"}
_FORMULAS = {
    "air": Material(
        "air",
        "vacuum: n = 1 by definition",
        DispersionFormula(5, (1.0,), (0.0, math.inf)),
    ),
    "SiO2": Material(
        "SiO2",
        "fused silica at 20 C: I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965); used up to 3.71 um",
        DispersionFormula(
            1,
            (0, 0.6961663, 0.0684043, 0.4079426, 0.1162414, 0.8974794, 9.896161),
            (0.21, 3.71),
        ),
    ),
}
# deposited films where the database has them, bulk else; o and e: ordinary and
# extraordinary ray
_PAGES = {
    "TiO2": "TiO2_Siefke",
    "TiO2-sputtered": "TiO2_Sarkar",
    "TiO2-rutile-o": "TiO2_Devore-o",
    "TiO2-rutile-e": "TiO2_Devore-e",
    "Si3N4": "Si3N4_Luke",
    "SiN": "Si3N4_Vogt-1",
    "GaN": "GaN_Barker-o",
    "GaN-e": "GaN_Barker-e",
    "sapphire": "Al2O3_Malitson-o",
    "sapphire-e": "Al2O3_Malitson-e",
    "Al2O3": "Al2O3_Boidin",
    "Ge": "Ge_Nunley",
    "Ge-infrared": "Ge_Burnett",
    "HfO2": "HfO2_Al-Kuhaili",
    "ITO": "ITO_Konig",
    "N-BK7": "SCHOTT_N-BK7",
    "Borofloat33": "SCHOTT_BOROFLOAT33",
    "D263": "SCHOTT_D263TECO",
    "PMMA": "PMMA_Beadie",
    "SU-8": "SU-8-2000_specs",
    "polycarbonate": "polycarbonate_Sultanova",
    "polystyrene": "polystyrene_Sultanova",
    "MgF2": "MgF2_Dodge-o",
    "MgF2-e": "MgF2_Dodge-e",
    "CaF2": "CaF2_Malitson",
    "Au": "Au_Johnson",
    "Ag": "Ag_Jiang",
    "Al": "Al_Cheng",
    "Cr": "Cr_Sytchkova",
    "TiN": "TiN_Beliaev-ALD",
    "Nb2O5": "Nb2O5_Lemarchand",
    "Ta2O5": "Ta2O5_Gao",
    "GaAs": "GaAs_Papatryfonos",
    "GaP": "GaP_Khmelevskaia",
    "AlN": "AlN_Beliaev1",
    "ZnS": "ZnS_Amotchkina",
    "c-Si": "Si_Schinke",
    "Si-infrared": "Si_Li-293K",
}
NAMES = tuple(sorted((*_TABLES, *_FORMULAS, *_PAGES)))
_WORDS = """
vacuum=air silicon=Si amorphous-silicon=a-Si crystalline-silicon=c-Si germanium=Ge bk7=N-BK7 glass=N-BK7 acrylic=PMMA
silica=SiO2 fused-silica=SiO2 quartz=SiO2 silicon-dioxide=SiO2 silicon-nitride=Si3N4 gallium-nitride=GaN
titania=TiO2 titanium-dioxide=TiO2 titanium-nitride=TiN hafnia=HfO2 niobia=Nb2O5 tantala=Ta2O5 alumina=Al2O3
gallium-arsenide=GaAs gallium-phosphide=GaP aluminium-nitride=AlN aluminum-nitride=AlN
gold=Au silver=Ag aluminium=Al aluminum=Al chromium=Cr chrome=Cr fused-quartz=SiO2 pc=polycarbonate
su-8-2000=SU-8 ps=polystyrene gan-o=GaN sapphire-o=sapphire al2o3-o=sapphire al2o3-e=sapphire-e mgf2-o=MgF2
rutile=TiO2-rutile-o zinc-sulfide=ZnS
"""
SPOKEN = dict(
    pair.split("=") for pair in _WORDS.split()
)  # what people type and no spelling leads from: its name


def index(material: record.Material | Material, wavelength_um: float) -> complex:
    """Refractive index n + ik at a vacuum wavelength.

    Args:
        material: a name of ``NAMES``, the path of a CSV file or of a YAML page of
            refractiveindex.info (see :mod:`metalens.cell.dispersion`), plain numbers
            (``cell.Index``), a ``cell.Blend``, or a ``Material``.
        wavelength_um: vacuum wavelength.

    Accuracy: that of the source. Between the rows of a table n and k are straight lines
    in the wavelength.

    Raises:
        MaterialError: unknown name, unreadable file, or a wavelength outside the range
            of the source.

    >>> round(index("SiO2", 0.85).real, 4)
    1.4525
    """
    if not (math.isfinite(wavelength_um) and wavelength_um > 0):
        raise MaterialError(
            f"wavelength {wavelength_um:.7g} um: need a finite length above 0"
        )
    if isinstance(material, Index):
        return complex(material.n, material.k)
    if isinstance(material, Blend):
        return _bruggeman(material, wavelength_um)
    constants = find_material(material) if isinstance(material, str) else material
    low, high = constants.range_um
    if not low <= wavelength_um <= high:
        raise MaterialError(
            f"{constants.name} at {wavelength_um} um: its source holds from {low:.6g} to "
            f"{high:.6g} um ({constants.source}); choose a wavelength inside, another "
            "material, or plain n and k"
        )
    k = constants.k.at(wavelength_um) if constants.k else 0.0
    return complex(constants.n.at(wavelength_um), max(0.0, k))


def find_material(name: str) -> Material:
    """The record behind a name of ``NAMES`` or behind the path of a CSV file or of a
    YAML page, which is read again when it changes.

    Raises:
        MaterialError: the name is unknown, or the file cannot be used.
    """
    if name in _FORMULAS:
        return _FORMULAS[name]
    path = Path(name)
    if name in _PAGES:
        path = _DATA / "materials" / f"{_PAGES[name]}.yml"
    elif name in _TABLES:
        path = _DATA / _TABLES[name]
    elif path.suffix.lower() not in (".yml", ".yaml", ".csv") and len(path.parts) == 1:
        raise MaterialError(
            f"unknown material {name!r}{_hint(name)}; or give the path of a CSV file or of a page (.yml)"
        )
    try:
        stat = path.stat()
    except OSError:
        raise MaterialError(
            f"{path}: no such file; need a CSV table or a YAML page of "
            "refractiveindex.info"
        ) from None
    return _read_material(path, name, (stat.st_mtime_ns, stat.st_size))


@lru_cache(maxsize=64)
def _read_material(path: Path, name: str, stamp: tuple[int, int]) -> Material:
    """Material of a file, called ``name``; ``stamp``: its time and size."""
    try:
        text = reading.read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise MaterialError(
            f"{path}: not a readable text file ({error}); need a CSV table or a YAML "
            "page"
        ) from None
    is_page = path.suffix.lower() in (".yml", ".yaml")
    n, k, source = (parse_page if is_page else parse_csv)(text, name)
    return Material(name, source, n, k)


def _hint(name: str) -> str:
    """What the word means, the same name in another case, or the nearest."""
    lower = name.lower().strip().replace("_", "-")
    same_name = [
        material for material in NAMES if material.lower() == lower.replace(" ", "")
    ]
    suggestion = next(iter(same_name), SPOKEN.get("-".join(lower.split())))
    return (
        f"; did you mean {suggestion!r}?"
        if suggestion
        else nearest_name_hint(name, NAMES)
    )


def _bruggeman(blend: Blend, wavelength_um: float) -> complex:
    """Index of a Bruggeman mixture.

    f (a - e) / (a + 2 e) + (1 - f) (b - e) / (b + 2 e) = 0 (D. A. G. Bruggeman, Ann.
    Phys. 416, 636 (1935)) for permittivities a, b. The solution is e = (h + sqrt(h² + 8
    a b)) / 4 with h = (3 f - 1) a + (2 - 3 f) b, the root with Im e >= 0. The offsets
    of the blend are added to n and k.
    """
    n = index(blend.base, wavelength_um)
    if blend.other:
        f = 1 - blend.share
        a, b = n**2, index(blend.other, wavelength_um) ** 2
        h = (3 * f - 1) * a + (2 - 3 * f) * b
        root = cmath.sqrt(h * h + 8 * a * b)
        e = (h + (-root if root.imag < 0 else root)) / 4
        n = cmath.sqrt(complex(e.real, max(e.imag, 0.0)))  # below 0 is rounding
    n += complex(blend.n_offset, blend.k_offset)
    if n.real <= 0 or n.imag < 0:
        raise MaterialError(
            f"blend of {blend.base} at {wavelength_um} um: n + ik = {n:.4g}; need n > 0 and k >= 0"
        )
    return n
