"""The command line under a launcher that started several ranks: rank 0 alone talks."""

import sys
from collections.abc import Sequence

from lmdsl.ranks.launchers import Launched


def main(arguments: Sequence[str] | None, launched: Launched) -> int:
    """Run the command line on this rank and return its exit status."""
    if launched.rank == 0:
        print(
            f"lmdsl: a launcher started {launched.ranks} ranks, each of which would do all the "
            "work; start one process",
            file=sys.stderr,
        )
    return 2
