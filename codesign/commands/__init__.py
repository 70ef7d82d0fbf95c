"""Verbs of co-design."""
