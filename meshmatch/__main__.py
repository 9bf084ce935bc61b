"""``python -m meshmatch`` runs the command `meshmatch`."""

import sys

from meshmatch.cli import main

sys.exit(main())
