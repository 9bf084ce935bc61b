"""What a file does not say: which way is up, in which unit. Guesses from extents alone, for people to read."""

from meshmatch.shapes.shape import Shape

# Standing people are 1.2 to 2.2 m tall; a unit fits if it makes that of the longest extent.
_SMALL, _TALL = 1.2, 2.2
_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "feet": 0.3048}


def long_axis(shape: Shape) -> str | None:
    """The axis along which the shape is clearly longest, "x", "y" or "z"; None if none is.

    Whatever stands or lies is longest along its up axis or its back; the sign cannot be told from extents.
    """
    extents = shape.bounds[1] - shape.bounds[0]
    order = extents.argsort()
    if extents[order[2]] < 1.15 * extents[order[1]]:
        return None
    return "xyz"[int(order[2])]


def guess_unit(shape: Shape) -> str | None:
    """The unit in which the shape would be as long as a standing person; None if there is none."""
    length = float((shape.bounds[1] - shape.bounds[0]).max())
    for name, metres in _UNITS.items():
        if _SMALL <= length * metres <= _TALL:
            return name
    return None
