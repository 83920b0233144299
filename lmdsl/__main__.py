"""``python -m lmdsl``."""

import sys

from lmdsl.cli import main

sys.exit(main())
