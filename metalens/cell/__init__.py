"""What a pillar cell is: geometry, materials, propagating orders, the answer of a
solver.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.cell import materials as materials
    from metalens.cell import shapes as shapes
    from metalens.cell.lattice import Lattice as Lattice
    from metalens.cell.light import Incidence as Incidence
    from metalens.cell.light import Polarization as Polarization
    from metalens.cell.light import check_direction as check_direction
    from metalens.cell.light import check_tolerance as check_tolerance
    from metalens.cell.materials import index as index
    from metalens.cell.materials import index_dispersion as index_dispersion
    from metalens.cell.orders import DiffractionOrder as DiffractionOrder
    from metalens.cell.orders import check_subwavelength as check_subwavelength
    from metalens.cell.orders import describe_order_loss as describe_order_loss
    from metalens.cell.orders import named_orders as named_orders
    from metalens.cell.orders import no_resonance_um as no_resonance_um
    from metalens.cell.orders import substrate_orders as substrate_orders
    from metalens.cell.record import Blend as Blend
    from metalens.cell.record import Cell as Cell
    from metalens.cell.record import Film as Film
    from metalens.cell.record import Index as Index
    from metalens.cell.record import Layer as Layer
    from metalens.cell.record import Material as Material
    from metalens.cell.response import Response as Response

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Blend": "record",
        "Cell": "record",
        "Film": "record",
        "Index": "record",
        "Lattice": "lattice",
        "Layer": "record",
        "Incidence": "light",
        "Material": "record",
        "DiffractionOrder": "orders",
        "Polarization": "light",
        "Response": "response",
        "check_direction": "light",
        "check_subwavelength": "orders",
        "named_orders": "orders",
        "no_resonance_um": "orders",
        "substrate_orders": "orders",
        "check_tolerance": "light",
        "describe_order_loss": "orders",
        "index": "materials",
        "materials": "",
        "shapes": "",
        "index_dispersion": "materials",
    },
)
