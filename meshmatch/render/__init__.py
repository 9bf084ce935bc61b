"""Pictures of shapes, without a GPU, OpenGL or a display."""

from meshmatch.render.colors import position_colors
from meshmatch.render.picture import Look, Panel, render_shapes

__all__ = ["Look", "Panel", "position_colors", "render_shapes"]
