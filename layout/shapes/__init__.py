"""Polygons on the grid of a mask."""
