"""Maps between shapes: the type, its files, geodesic distances and errors. Arrays only, no torch."""

MAP_SUFFIXES = (".npy", ".npz", ".csv", ".txt", ".mat", ".json")
"""What `meshmatch.maps.files` reads and writes; here, because a command asks before it loads NumPy."""
