"""Backends made of one function, and what they are asked."""

from __future__ import annotations

from problems import standard_map

from lmdsl.backends import Backend, Capabilities, Options, Solution, Stop
from lmdsl.backends.asking import ask

PROBLEM = standard_map(10)


def foreign(function, **parts):
    return Backend("foreign", function, Capabilities(**parts))


def asked(lp, function, **options):
    start = lp.tree[1].copy()
    return ask(lp, foreign(function), Options(start=start, **options))[0]


def optimal(lp, **parts):
    return Solution(Stop.OPTIMAL, "optimal", **parts)


class Unspeakable:
    def __str__(self):
        raise RuntimeError("no")

    __repr__ = __str__
