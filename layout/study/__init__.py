"""Effect of process variation and stitching on the focus."""
