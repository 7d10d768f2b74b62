"""`python -m scb`, where the console script is not on the path."""

import sys

from scb.cli import main

sys.exit(main())
