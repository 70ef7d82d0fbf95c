"""Diameter map to classes, lattices, die and write fields: the plan of a mask."""
