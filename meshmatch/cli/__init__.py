"""The command line: thin verbs that import nothing heavy before they need it, so that ``--help`` answers at once."""

from meshmatch.cli.boundary import main as main
