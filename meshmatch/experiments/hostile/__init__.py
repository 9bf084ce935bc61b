"""Robustness tests: damaged files and killed commands."""
