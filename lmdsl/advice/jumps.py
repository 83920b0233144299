"""Findings about steps that jump over the attractor where only their ends are judged."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from lmdsl.advice.report import Finding
from lmdsl.advice.survey import Survey
from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.explanation import remedies
from lmdsl.explanation.trials import some
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.sampler import Block, Sampler
from lmdsl.model.grid.partition import Partition
from lmdsl.problem.problem import Problem

COVERED = 0.9  # share of the cells stabilized from which on no way over A is looked for
OVER = 0.9  # share of the samples on the way into A that jump over it, from which on a step is long
JUMP = 0.25  # share of an axis above which a median move is no motion that has a way
MOST_NEAR = 256  # number of cells beside A that are tried
MOST_PLACES = 32  # number of places on the way of a sample
SAMPLES = 2**18  # number of samples whose path is followed


def long_step(survey: Survey, share: float | None, deadline: Deadline) -> Iterator[Finding]:
    """Find that samples jump over A, where more can be stabilized otherwise, or may be.

    Nothing where the whole path is judged; ``share`` is that of the problem's cells that can be
    stabilized, None if it is not known.
    """
    if survey.sets is None or survey.problem.judged == "path" or not len(survey.cells):
        return
    near = beside(survey.partition, survey.sets.attractor, survey.sets.free)
    if not len(near):
        return
    if remedies.longer_step(survey.problem, 1) is None:
        yield from _of_map(survey, share, near)
    else:
        yield from _of_equation(survey, share, near, deadline)


def _of_equation(
    survey: Survey, share: float | None, near: Indices, deadline: Deadline
) -> Iterator[Finding]:
    """Follow the paths, and compile them where that is cheap."""
    system: Any = survey.problem.system
    along = survey.problem.replaced(system=system.replaced(judged="path"))
    then = None
    if share is not None and remedies.cheap(along, remedies.TRIAL):
        then = remedies.coverage(along, deadline).share
        if then < share + remedies.ABOUT:
            return
    elif share is not None and share >= COVERED:
        return
    landed, over = _paths(survey, along, np.union1d(near, survey.cells))
    if over == 0 or (then is None and over < OVER * (landed + over)):
        return
    text = (
        f"of the samples whose path meets the attractor, {100 * over / (landed + over):.3g} % run "
        "over it, and only where a step ends is judged"
    )
    figures: dict[str, Any] = {"landing": landed, "jumping": over}
    remedy = (
        'write "judged": "path" in system, so that a step that enters the attractor on the way '
        "counts"
    )
    if then is not None and share is not None:
        figures |= {"share": share, "share_then": then}
        remedy += (
            f": then {100 * then:.3g} % of the cells can be stabilized instead of "
            f"{100 * share:.3g} %"
        )
    yield Finding("long_step", "system.step", text, remedy, figures)


def _paths(survey: Survey, along: Problem, cells: Indices) -> tuple[int, int]:
    """Return how many samples end in A, and how many enter it on the way and end elsewhere."""
    assert survey.sets is not None
    p, sets = survey.partition, survey.sets
    ends, paths = (Sampler(one, p, sets=sets) for one in (survey.problem, along))
    M, S = len(ends.controls), ends.samples
    width = min(M, max(1, SAMPLES // S))
    cells = some(cells, max(1, SAMPLES // (width * S)))
    size = max(1, ends.chunk // (width * S))
    firsts = np.linspace(0, M - width, -(-len(cells) // size)).astype(int).tolist()
    landed = over = 0
    for i, first in enumerate(firsts):
        survey.guard()
        block = Block(0, cells[i * size : (i + 1) * size], (first, first + width))
        at_end, on_way = (_entered(one, block, sets.attractor) for one in (ends, paths))
        landed += int(at_end.sum())
        over += int((on_way & ~at_end).sum())
    return landed, over


def _entered(sampler: Sampler, block: Block, attractor: Bools) -> Bools:
    index = sampler.images(block, sampler.values(block))
    inside = np.isfinite(index)
    entered: Bools = inside & attractor[np.where(inside, index, 0).astype(np.int64)]
    return entered


def _of_map(survey: Survey, share: float | None, cells: Indices) -> Iterator[Finding]:
    """Look at the straight ways of samples beside A, where too little is stabilized or known."""
    assert survey.sets is not None
    p, attractor = survey.partition, survey.sets.attractor
    if share is not None and share >= COVERED:
        return
    if float(np.median(survey.moved)) * float((p.width / survey.span).min()) > JUMP:
        return
    landed, over, far = _ways(survey, cells, attractor)
    if over == 0 or over < OVER * (landed + over):
        return
    text = (
        f"of the samples beside A whose way leads into it, {100 * over / (landed + over):.3g} % "
        f"jump over it; the median sample there moves {far:.2g} widths of A"
    )
    figures: dict[str, Any] = {"landing": landed, "jumping": over, "widths_of_attractor": far}
    remedy = f"make attractor {max(int(np.ceil(far)), 2)} times as wide, or let next be less time"
    yield Finding("long_step", "attractor", text, remedy, figures)


def beside(p: Partition, attractor: Bools, free: Indices) -> Indices:
    """Return free cells beside attractor cells, at most so many."""
    random = np.random.default_rng(0)
    inside = np.flatnonzero(attractor)
    if len(inside) > MOST_NEAR:
        inside = np.sort(random.choice(inside, MOST_NEAR, replace=False))
    index = np.stack(p.multi_index(inside), axis=-1)
    found = []
    for k in range(p.dimension):
        for side in (-1, 1):
            at = index.copy()
            at[:, k] += side
            if p.periodic[k]:
                at[:, k] %= p.cells[k]
            good = (at[:, k] >= 0) & (at[:, k] < p.cells[k])
            found.append(np.ravel_multi_index(tuple(at[good].T), p.shape))
    near = np.intersect1d(np.concatenate(found), free)
    if len(near) > MOST_NEAR:
        near = np.sort(random.choice(near, MOST_NEAR, replace=False))
    return near


def _ways(survey: Survey, cells: Indices, attractor: Bools) -> tuple[int, int, float]:
    """Return how many samples land in A, how many jump over it, and their median move.

    The way of a sample is the straight line to its image; the move is in widths of A.
    """
    p = survey.partition
    index = np.stack(p.multi_index(np.flatnonzero(attractor)), axis=-1)
    widths = p.width * [_longest_run(np.unique(column)) for column in index.T]
    landed = over = 0
    moves = []
    for begin in range(0, len(cells), max(1, survey.most_cells // MOST_PLACES)):
        some = cells[begin : begin + max(1, survey.most_cells // MOST_PLACES)]
        start = survey.start(some)
        images = survey.images(start, survey.vectors())
        shape = survey.shape(some)
        far: Floats = np.zeros(shape)
        for x, image, width in zip(start, images, widths, strict=True):
            np.fmax(far, np.abs(image - x) / width, out=far)
        moves.append(np.median(far, axis=(1, 2, 3)))
        on_way = np.zeros(shape, dtype=np.bool_)
        for part in np.arange(1, MOST_PLACES + 1) / MOST_PLACES:
            at = [x + part * (image - x) for x, image in zip(start, images, strict=True)]
            flat = np.broadcast_to(p.locate(at), shape)
            inside = (flat >= 0) & attractor[flat]
            if part == 1:
                landed += int(inside.sum())
                over += int((on_way & ~inside).sum())
            on_way |= inside
    return landed, over, float(np.median(np.concatenate(moves)))


def _longest_run(values: Indices) -> int:
    """Return the length of the longest run of consecutive integers."""
    cuts = np.flatnonzero(np.diff(values) != 1)
    ends = np.concatenate([[-1], cuts, [len(values) - 1]])
    return int(np.diff(ends).max())
