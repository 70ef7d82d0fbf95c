"""Metalens layout and its page."""
