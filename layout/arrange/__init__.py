"""Several lenses and cells on a die, dies on a wafer."""
