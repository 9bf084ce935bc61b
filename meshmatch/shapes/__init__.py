"""Shapes: reading, repairing, thinning, scaling and sampling them. NumPy arrays in, NumPy arrays out."""

from meshmatch.shapes.files import SUFFIXES, load_shape, save_shape
from meshmatch.shapes.shape import Shape

__all__ = ["SUFFIXES", "Shape", "load_shape", "save_shape"]
