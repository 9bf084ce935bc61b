"""``python -m meshmatch`` is the command `meshmatch`."""

import sys

from meshmatch.cli import main

sys.exit(main())
