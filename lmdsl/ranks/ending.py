"""How a program of several ranks ends: whole on every rank, or on none.

An error that one rank meets outside :meth:`Ranks.agreed` leaves the others waiting for it; plain
MPI lets them wait for ever. So it is said once, and all ranks are ended.
"""

import sys
from collections.abc import Callable

from lmdsl.errors import plain_text
from lmdsl.ranks.mpi import MpiRanks
from lmdsl.ranks.verbs import Item, Ranks

INTERRUPTED, FAILED = 130, 4  # exit statuses


def together(ranks: Ranks, program: Callable[[Ranks], Item]) -> Item:
    """Return ``program(ranks)``; where it raises on some rank, end all of them.

    An error that every rank meets alike, as :meth:`Ranks.agreed` makes it, goes on to the caller:
    it bears ``agreed``.
    """
    if not isinstance(ranks, MpiRanks):
        return program(ranks)
    try:
        return program(ranks)
    except BaseException as error:
        if getattr(error, "agreed", False) or isinstance(error, SystemExit):
            raise
        kind = type(error).__name__
        sys.stderr.write(f"rank {ranks.rank} of {ranks.count}: {kind}: {plain_text(error)}\n")
        ranks.abort(INTERRUPTED if isinstance(error, KeyboardInterrupt) else FAILED)
        raise
