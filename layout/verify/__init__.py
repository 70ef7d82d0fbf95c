"""Exposure and etch of the written files, from files and dose table alone."""
