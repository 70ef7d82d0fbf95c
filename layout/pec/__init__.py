"""Proximity effect correction: exposure of a die, dose of every shape."""
