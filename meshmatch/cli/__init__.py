"""The command line: thin commands that import heavy modules only when needed, so that ``--help`` is fast."""

from meshmatch.cli.boundary import main as main
