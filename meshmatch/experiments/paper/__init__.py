"""Reproduction of the paper's tables and figures, and of the methods that they compare with."""
