"""What writer and etch can do (records only)."""
