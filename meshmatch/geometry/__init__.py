"""Geometry of plain arrays: frames, triangles, oriented points, topology."""
