"""Carrying what lies on one shape to another, along a map. Arrays in, arrays out.

Everything is pulled back: a map from the target to the source says for each vertex of the target where on the
source its value comes from (`direction`); landmarks alone go forward.
"""
