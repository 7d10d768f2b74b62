"""`python -m lpo`, where the console script is not on the path."""

import sys

from lpo.cli import main

sys.exit(main())
