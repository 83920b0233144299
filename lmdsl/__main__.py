"""``python -m lmdsl``."""

import sys

try:
    from lmdsl.cli import main

    sys.exit(main())
except KeyboardInterrupt:  # before main() could take care of it
    print("lmdsl: interrupted", file=sys.stderr)
    sys.exit(130)
