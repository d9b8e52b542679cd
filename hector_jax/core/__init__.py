"""Geometry, types, input checks and processes, shared by all other packages."""
