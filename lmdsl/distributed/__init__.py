"""The verbs over ranks, and what they return: facts that all share, arrays of own cells."""

from lmdsl.distributed.answer import Answer as Answer
from lmdsl.distributed.solving import solve as solve
from lmdsl.distributed.verifying import verify as verify

__all__ = ["Answer", "solve", "verify"]
