"""Maps between shapes: the type, its files, geodesic distances and errors. NumPy only, no torch."""

MAP_SUFFIXES = (".npy", ".npz", ".csv", ".txt", ".mat", ".json")
"""Suffixes that `meshmatch.maps.files` reads and writes; defined here because commands need them before NumPy is loaded."""
