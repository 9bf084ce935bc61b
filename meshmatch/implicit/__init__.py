"""Implicit models: a category as the signed distance function of one template, deformed for every shape by its code.

For categories whose shapes need not share a topology, such as chairs. Needs the extra `implicit` (torch, scikit-image).
"""
