"""Maps between shapes: the noun, its files, its distances and its errors. Arrays in, arrays out."""

from meshmatch.maps.files import MAP_SUFFIXES, load_map, save_map
from meshmatch.maps.vertex_map import VertexMap

__all__ = ["MAP_SUFFIXES", "VertexMap", "load_map", "save_map"]
