"""A modal method for round pillars: exact along z, elements that follow the disc across."""

from metalens.modal.engine import solve

__all__ = ["solve"]
