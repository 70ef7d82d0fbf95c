"""Derivatives of the Jones matrices of any pillar by every number of its shape, section and material."""
