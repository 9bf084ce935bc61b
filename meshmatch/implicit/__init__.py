"""Implicit surfaces: a category as the signed distance of one template, deformed for every shape by its code.

For shapes of one kind that need not share a topology, such as chairs. Needs the extra `implicit` (torch, scikit-image).
"""
