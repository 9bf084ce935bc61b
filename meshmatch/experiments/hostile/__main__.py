import sys

from meshmatch.experiments.hostile.campaign import main

sys.exit(main())
