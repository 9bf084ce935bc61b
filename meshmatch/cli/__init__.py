"""The command line: thin verbs, and one boundary where errors become words and an exit status.

Nothing heavy is imported before a verb needs it, so that ``meshmatch --help`` answers at once.
"""

from meshmatch.cli.boundary import main

__all__ = ["main"]
