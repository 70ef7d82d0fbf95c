"""Verbs of the bench."""
