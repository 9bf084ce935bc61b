import sys

from meshmatch.experiments.bench.accuracy import main

sys.exit(main())
