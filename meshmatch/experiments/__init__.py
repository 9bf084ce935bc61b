"""Experiments: published protocols and development benchmarks, each a command that prints tables and a JSON line."""
