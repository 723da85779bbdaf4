"""`python -m jaxsfm`: the command line."""

import sys

from jaxsfm.cli.main import main

sys.exit(main())
