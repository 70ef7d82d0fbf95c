"""Refractive index of the materials of a cell: published ones with source and range,
own CSV or YAML, plain numbers.

YAML files are pages of refractiveindex.info (:mod:`metalens.cell.database`).
Time factor exp(-iwt): an absorbing material has k > 0. Nothing is extrapolated.
"""

import bisect
import importlib.resources
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from metalens import cell
from metalens.cell import database, tables
from metalens.cell.database import Part
from metalens.core import reading
from metalens.core.arrays import Array
from metalens.core.errors import MaterialError, nearest_name_hint


@dataclass(frozen=True, eq=False, slots=True)
class Material:
    """Optical constants of one material.

    name, source: what it is, and where the numbers come from.
    range_um: shortest and longest vacuum wavelength for which they hold.
    table: (3, rows) wavelength_um, n, k; empty for a Sellmeier material.
    sellmeier: ((B, resonance_um), ...) of n² = 1 + sum B l² / (l² - resonance²); empty
    for a table.
    page: n, and k where it is not 0, of a database page instead.
    """

    name: str
    source: str
    range_um: tuple[float, float]
    table: Array
    sellmeier: tuple[tuple[float, float], ...] = ()
    page: tuple[Part, ...] = ()


_TABLES = {"a-Si": "a-Si.csv", "Si": "Si.csv"}
_NO_TABLE = np.empty((3, 0))
_FORMULAS = {
    "air": Material("air", "vacuum: n = 1 by definition", (0.0, math.inf), _NO_TABLE),
    "SiO2": Material(
        "SiO2",
        "fused silica at 20 C: I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965); used up to 3.71 um",
        (0.21, 3.71),
        _NO_TABLE,
        ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161)),
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


def index(material: cell.Material | Material, wavelength_um: float) -> complex:
    """Refractive index n + ik at a vacuum wavelength.

    Args:
        material: a name of ``NAMES``, the path of a CSV file (:func:`read_csv`) or of a
            YAML page of
            refractiveindex.info, plain numbers (``cell.Index``), a ``cell.Blend``, or a
            ``Material``.
        wavelength_um: vacuum wavelength.

    Accuracy: that of the source. Between the rows of a table n and k are straight lines
    in the wavelength (the
        slope jumps at the rows).

    Raises:
        MaterialError: unknown name, unreadable CSV, or a wavelength outside the range
            of the source.

    >>> round(index("SiO2", 0.85).real, 4)
    1.4525
    """
    return _index_and_slope(material, wavelength_um)[0]


def index_dispersion(
    material: cell.Material | Material, wavelength_um: float
) -> complex:
    """Dispersion d(n + ik)/d(wavelength_um) of a ``material``, with the arguments and
    errors of :func:`index`.
    """
    return _index_and_slope(material, wavelength_um)[1]


def find_material(name: str) -> Material:
    """The record behind a name of ``NAMES`` or behind the path of a CSV file.

    Raises:
        MaterialError: the name is unknown, or the file cannot be used.
    """
    if name in _FORMULAS:
        return _FORMULAS[name]
    if name in _TABLES or name in _PAGES:
        return _shipped(name)
    path = Path(name)
    if path.suffix.lower() in (".yml", ".yaml"):
        return read_yaml(path)
    if path.suffix.lower() == ".csv" or len(path.parts) > 1:
        return read_csv(path)
    raise MaterialError(
        f"unknown material {name!r}{_hint(name)}; or give the path of a CSV file or of a page (.yml)"
    )


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


def _table_hint(name: str, wavelength_um: float) -> str:
    """Shipped tables of the same substance that hold at a wavelength, in the words of a
    message.
    """
    same_substance = [
        material
        for material in NAMES
        if material != name and _substance(material) == _substance(name)
    ]
    ranges = {material: find_material(material).range_um for material in same_substance}
    in_range = [
        repr(material)
        for material, (low, high) in ranges.items()
        if low <= wavelength_um <= high
    ]
    return f" ({' or '.join(in_range)} holds there)" if in_range else ""


def _substance(name: str) -> list[str]:
    """Words of a material's name without phase, axis and process."""
    return [
        word
        for word in name.split("-")
        if word not in ("a", "c", "o", "e", "rutile", "sputtered", "infrared")
    ]


def read_yaml(path: str | Path) -> Material:
    """A material from a page of refractiveindex.info.

    path: of the YAML file.

    Raises:
        MaterialError: no such file, or no such page; see :mod:`metalens.cell.database`.
    """
    path = Path(path)
    if not path.is_file():
        raise MaterialError(
            f"{path}: no such file; need a YAML page of refractiveindex.info"
        )
    stat = path.stat()
    return _read_yaml(path, (stat.st_mtime_ns, stat.st_size))


@lru_cache(maxsize=64)
def _read_yaml(path: Path, stamp: tuple[int, int]) -> Material:
    return _of_page(database.load_page(path, str(path)), str(path))


def _of_page(page: tuple[Part, Part | None, str], name: str) -> Material:
    n, k, source = page
    low, high = n.range_um
    if k is not None:
        low, high = max(low, k.range_um[0]), min(high, k.range_um[1])
    if low >= high:
        raise MaterialError(
            f"{name}: n holds from {n.range_um[0]:g} to {n.range_um[1]:g} um, and k at no wavelength of these"
        )
    return Material(
        name, source, (low, high), _NO_TABLE, (), (n,) if k is None else (n, k)
    )


def read_csv(path: str | Path) -> Material:
    """A material of a table wavelength_um, n, k (:mod:`metalens.cell.tables`).

    path: of the CSV file.

    Raises:
        MaterialError: no such file, a missing column, or a bad row; the message gives
            the line.
    """
    try:
        stat = Path(path).stat()
    except OSError:
        raise MaterialError(
            f"{path}: no such file; need a CSV with columns {tables.COLUMNS}"
        ) from None
    return _read_csv(Path(path), (stat.st_mtime_ns, stat.st_size))


@lru_cache(maxsize=64)
def _read_csv(path: Path, stamp: tuple[int, int]) -> Material:
    try:
        text = reading.read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise MaterialError(
            f"{path}: not a readable text file ({error}); need a CSV table"
        ) from None
    return _parse(text, name=str(path), where=str(path))


@lru_cache(maxsize=64)
def _shipped(name: str) -> Material:
    """Material of a name in the tables and pages of the package."""
    if name in _PAGES:
        file = (
            importlib.resources.files("metalens")
            / "data"
            / "materials"
            / f"{_PAGES[name]}.yml"
        )
        return _of_page(
            database.parse_page(file.read_text(encoding="utf-8"), file.name), name
        )
    text = (importlib.resources.files("metalens") / "data" / _TABLES[name]).read_text(
        encoding="utf-8"
    )
    return _parse(text, name=name, where=_TABLES[name])


def _parse(text: str, *, name: str, where: str) -> Material:
    table, comments = tables.parse_table(text, where)
    return Material(
        name, comments or f"the file {where}", (table[0, 0], table[0, -1]), table
    )


def _index_and_slope(
    material: cell.Material | Material, wavelength_um: float
) -> tuple[complex, complex]:
    """n + ik of a material and its derivative in wavelength, 1/um.

    Raises:
        MaterialError: a wavelength outside the material's range.
    """
    if not (math.isfinite(wavelength_um) and wavelength_um > 0):
        raise MaterialError(
            f"wavelength {wavelength_um:.7g} um: need a finite length above 0"
        )
    if isinstance(material, cell.Index):
        return complex(material.n, material.k), 0j
    if isinstance(material, cell.Blend):
        return _bruggeman(material, wavelength_um)
    record = find_material(material) if isinstance(material, str) else material
    low, high = record.range_um
    if not low <= wavelength_um <= high:
        raise MaterialError(
            f"{record.name} at {wavelength_um} um: its source holds from {low:.6g} to {high:.6g} um ({record.source}); "
            f"choose a wavelength inside, another material{_table_hint(record.name, wavelength_um)}, or plain n and k"
        )
    if record.page:
        n = record.page[0].at(wavelength_um)
        k = record.page[-1].at(wavelength_um) if len(record.page) > 1 else (0, 0)
        return complex(n[0].real, max(0.0, k[0].real)), complex(n[1].real, k[1].real)
    if record.table.size:
        return _from_table(record, wavelength_um)
    return _from_sellmeier(record, wavelength_um)


def _bruggeman(blend: cell.Blend, wavelength_um: float) -> tuple[complex, complex]:
    """Index of a Bruggeman mixture and its slope in wavelength, 1/um.

    f (a - e) / (a + 2 e) + (1 - f) (b - e) / (b + 2 e) = 0 (D. A. G. Bruggeman, Ann.
    Phys. 416, 636 (1935)) for permittivities a, b. The solution is e = (h + sqrt(h² + 8
    a b)) / 4 with h = (3 f - 1) a + (2 - 3 f) b, the root with Im e >= 0. The offsets
    of the blend are added to n and k.
    """
    base, base_rate = _index_and_slope(blend.base, wavelength_um)
    n, rate = base, base_rate
    if blend.other:
        other, other_rate = _index_and_slope(blend.other, wavelength_um)
        f = 1 - blend.share
        a = base**2
        b = other**2
        da = 2 * base * base_rate
        db = 2 * other * other_rate
        h = (3 * f - 1) * a + (2 - 3 * f) * b
        dh = (3 * f - 1) * da + (2 - 3 * f) * db
        root = np.sqrt(h * h + 8 * a * b + 0j)
        root = -root if root.imag < 0 else root
        e = (h + root) / 4
        de = (dh + (h * dh + 4 * (a * db + b * da)) / root) / 4
        n = complex(np.sqrt(complex(e.real, max(e.imag, 0.0))))  # below 0 is rounding
        rate = complex(de / (2 * n))
    n += complex(blend.n_offset, blend.k_offset)
    if n.real <= 0 or n.imag < 0:
        raise MaterialError(
            f"blend of {blend.base} at {wavelength_um} um: n + ik = {n:.4g}; need n > 0 and k >= 0"
        )
    return n, rate


def _from_sellmeier(record: Material, wavelength_um: float) -> tuple[complex, complex]:
    """n² = 1 + sum B l² / (l² - c²), and d(n²)/dl = -2 l sum B c² / (l² - c²)²."""
    l2 = wavelength_um**2
    n = math.sqrt(1 + sum(b * l2 / (l2 - c * c) for b, c in record.sellmeier))
    rate = (
        -wavelength_um
        / n
        * sum(b * c * c / (l2 - c * c) ** 2 for b, c in record.sellmeier)
    )
    return complex(n), complex(rate)


def _from_table(record: Material, wavelength_um: float) -> tuple[complex, complex]:
    """n + ik and its slope by linear interpolation in the table."""
    x, n, k = record.table
    i = min(max(bisect.bisect_right(x, wavelength_um) - 1, 0), len(x) - 2)
    rate = complex(n[i + 1] - n[i], k[i + 1] - k[i]) / (x[i + 1] - x[i])
    share = (wavelength_um - x[i]) / (x[i + 1] - x[i])
    real = n[i] + share * (n[i + 1] - n[i])
    return complex(real, (1 - share) * k[i] + share * k[i + 1]), rate
