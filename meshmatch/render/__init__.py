"""Pictures of shapes, without a GPU, OpenGL or a display."""

from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.render.scales import position_colors

__all__ = ["Look", "Panel", "position_colors", "render_shapes"]
