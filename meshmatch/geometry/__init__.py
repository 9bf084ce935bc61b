"""Geometry on plain arrays: frames, oriented points, triangles."""
