"""Transfer of what lies on one shape to another, along a map. Arrays in, arrays out; no torch.

Values, labels, weights and textures are pulled back: a map from the target to the source says for each vertex of the
target where on the source its value comes from. Landmarks alone are pushed forward, by a map from source to target.
"""
