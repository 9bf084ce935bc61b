"""Published protocols and this project's development benchmark: each a command that prints a table and a JSON
line.
"""
