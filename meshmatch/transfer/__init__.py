"""Transfer of data from one shape to another along a map. Arrays in, arrays out; no torch.

Values, labels, weights and textures are pulled back: a map from target to source gives, for each vertex of the target, the
place on the source that its value is taken from. Only landmarks are pushed forward, by a map from source to target.
"""
