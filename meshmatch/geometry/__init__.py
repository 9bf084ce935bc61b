"""Geometry of plain arrays: frames, oriented points, triangles."""
