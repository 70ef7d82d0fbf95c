"""Mask files: cells in memory, one reader and one writer a format, comparison."""
