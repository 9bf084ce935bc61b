"""Shapes: reading, repairing, thinning, scaling and sampling them. NumPy arrays in, NumPy arrays out."""
