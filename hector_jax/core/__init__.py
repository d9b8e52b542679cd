"""Geometry, types, input checks, processes: what every other package uses."""
