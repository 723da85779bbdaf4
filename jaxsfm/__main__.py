"""`python -m jaxsfm`: the command line."""

import sys

from jaxsfm.cli import main

sys.exit(main())
