"""Shapes: reading, repairing, thinning, scaling and sampling them. NumPy arrays in, NumPy arrays out."""

from meshmatch.shapes.files import SUFFIXES, load_shape, save_shape
from meshmatch.shapes.shape import Frame, Shape

__all__ = ["SUFFIXES", "Frame", "Shape", "load_shape", "save_shape"]
