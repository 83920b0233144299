"""What is certified of a result and what is not: each claim with what it speaks of and its figure.

Every row says how much it is worth: ``proved``; ``refuted``; ``not proved``; ``assumed``, where it
rests on what was only promised; ``evidence``, where it comes from samples or runs; ``unknown``.
"""

from collections.abc import Iterator

from lmdsl.proof.record import Proof
from lmdsl.report.mathematics import number
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status
from lmdsl.systems import MatrixSystem

PROVED, REFUTED, OPEN, ASSUMED, EVIDENCE, UNKNOWN = (
    "proved", "refuted", "not proved", "assumed", "evidence", "unknown",
)  # fmt: skip
MODEL, TRUE, BOTH = "finite model", "true map", "true map as compiled"

# Why a problem is refused.
REFUSED = {
    Cause.EMPTY: "there is no cell from which A is reached for certain",
    Cause.MEASURE: "no cell that carries weight of m can be stabilized",
    Cause.GAMMA: "no law has a finite cost at this weight γ",
    Cause.REQUIRE_ALL: "not every cell outside A and Z can be stabilized, which was asked for",
    Cause.HOLD: "no attractor cell can be held",
}

ClaimRow = dict[str, str]


def claims_of(result: Result, proof: Proof | None) -> list[ClaimRow]:
    """Return the claims, those of the finite model first, then those of the true map."""
    rows = [*_coverage(result)]
    if result.status == Status.NOT_STABILIZABLE:
        rows += [*_refusal(result)]
    else:
        rows += [*_model(result)]
    return [*rows, *_safe(result), *_data(result), *_local(result), *_integration(result),
            *_runs(result), *_proof(result, proof)]  # fmt: skip


def _row(worth: str, about: str, claim: str, figure: str) -> ClaimRow:
    return {"worth": worth, "about": about, "claim": claim, "figure": figure}


def _known(value: float | None, digits: int = 9) -> str:
    return "not established" if value is None else number(value, digits)


def percent(share: float, digits: int = 4) -> str:
    """Return a share in per cent; 100 % only where it is all."""
    value = 100 * share if share in (0, 1) else min(max(100 * share, 1e-4), 99.9999)
    return f"{value:.{digits}g} %"


def _worth(holds: bool) -> str:
    return PROVED if holds else OPEN


def _coverage(result: Result) -> Iterator[ClaimRow]:
    covered = result.coverage
    if covered is None:
        yield _row(UNKNOWN, MODEL, "How much of the box can be stabilized", "not compiled in time")
        return
    share = "no free cell" if covered.share is None else percent(covered.share)
    figure = f"{share}: {covered.stabilizable:,} of {covered.free:,} cells outside A and Z"
    claim = "How much of the box can be stabilized, and is served (coverage); the rest see below"
    if result.status == Status.NOT_STABILIZABLE:
        claim = "How much of the box could be stabilized, all that is refused here apart"
    yield _row(PROVED, MODEL, claim, figure)


def _refusal(result: Result) -> Iterator[ClaimRow]:
    figure = ""
    if result.gamma_bar:
        low, high = result.gamma_bar
        figure = f"largest feasible weight γ between {number(low, 9)} and {number(high, 9)}"
    why = "as asked" if result.cause is None else REFUSED[result.cause]
    yield _row(PROVED, MODEL, f"It cannot be stabilized: {why}", figure)


def _model(result: Result) -> Iterator[ClaimRow]:
    held = result.certificate
    goal = "ends" if result.problem.attractor.empty else "reaches A"
    bound = "" if held.contraction is None else f"contraction {number(held.contraction, 6)} < 1"
    yield _row(_worth(held.stabilizing), MODEL,
               f"From every stabilizable cell the closed loop {goal} with probability 1, "
               "geometrically fast", bound)  # fmt: skip
    yield _row(_worth(held.upper_bound), MODEL, "The law costs at most, in the mean over the "
               "starts m", _known(held.cost))  # fmt: skip
    word = "No law that keeps to the stabilizable set costs less than"
    if result.proved is not None and result.proved.lower_bound is not None:
        figure = f"{_known(held.lower)}; with the dropped pairs {_known(result.proved.lower_bound)}"
        yield _row(_worth(held.lower_bound), MODEL, f"{word} (without the dropped pairs)", figure)
    else:
        yield _row(_worth(held.lower_bound), MODEL, word, _known(held.lower))
    gap = "not established" if held.gap is None else f"at most {number(held.gap, 2)}"
    near = held.gap is not None and held.gap <= held.tolerance
    yield _row(_worth(near), MODEL, "So the law is optimal up to the relative gap",
               f"{gap} (asked for: {number(held.tolerance, 2)})")  # fmt: skip
    off = "" if held.measure_residual is None else f"residual {number(held.measure_residual, 2)}"
    yield _row(_worth(held.measure), MODEL, "A Lyapunov measure exists and is given", off)


def _safe(result: Result) -> Iterator[ClaimRow]:
    safe = result.certificate.safe
    if safe is None:
        given = isinstance(result.problem.system, MatrixSystem)  # without samples
        if not given and result.problem.successors != "enclosed" and result.verified:
            claim = "That no run between the sample points is lost: the model sees samples only"
            yield _row(OPEN, TRUE, claim, "successors are sampled, not enclosed")
        return
    worth = {True: PROVED, False: OPEN, "assumed": ASSUMED}[safe]
    figure = "" if safe != "assumed" else "rests on the Lipschitz constants that were promised"
    yield _row(worth, BOTH, "No run from the stabilizable set is ever lost", figure)
    if result.sure_cells is not None:
        yield _row(PROVED, BOTH, "Some controller surely arrives", f"from {result.sure_cells:,} "
                   "cells")  # fmt: skip


def _data(result: Result) -> Iterator[ClaimRow]:
    if result.data is None:
        return
    yield _row(ASSUMED, "what was recorded", "; ".join(f"{k}: {v}" for k, v in result.data.rows()),
               result.data.sentence())  # fmt: skip


def _local(result: Result) -> Iterator[ClaimRow]:
    local = result.local_controller
    if local is None:
        if not result.problem.attractor.empty and result.verified:
            about = MODEL if isinstance(result.problem.system, MatrixSystem) else TRUE
            yield _row(OPEN, about, "What happens inside A after it is reached: the problem names "
                       "no controller there", "no local controller")  # fmt: skip
        return
    kept = local.proved is not None and local.proved == (local.holding or local.cells)
    worth = PROVED if kept else REFUTED if local.kept < local.samples else EVIDENCE
    yield _row(worth, BOTH, "Inside A the local controller keeps the state", local.sentence())


def _integration(result: Result) -> Iterator[ClaimRow]:
    error = result.integration_error
    if error is not None:
        worth = OPEN if error.excessive else EVIDENCE
        yield _row(worth, TRUE, "The compiled steps follow the differential equation",
                   error.sentence())  # fmt: skip


def _runs(result: Result) -> Iterator[ClaimRow]:
    runs = result.simulation
    if runs is None:
        return
    if not runs.aimed:
        share = percent(1 - runs.lost / runs.starts)
        yield _row(EVIDENCE, runs.followed, f"Of {runs.starts:,} runs from random starts stay",
                   share)  # fmt: skip
        return
    low, high = runs.interval
    figure = f"{percent(runs.reached / runs.starts)} (95 % interval {percent(low)} to " \
        f"{percent(high)})"  # fmt: skip
    yield _row(EVIDENCE, runs.followed, f"Of {runs.starts:,} runs from random starts reach A",
               figure)  # fmt: skip
    if runs.cost:
        mean, error = runs.cost["mean"], runs.cost["standard_error"]
        spread = "" if error is None else f" ± {number(error, 2)} (standard error)"
        yield _row(EVIDENCE, runs.followed, "They cost, in the mean", f"{_known(mean, 6)}{spread}")


def _share(proof: Proof, claim: str, share: float) -> ClaimRow:
    """Return what is proved of a share: what is undecided may belong to it, too."""
    if proof.undecided == 0:
        return _row(PROVED, TRUE, claim, percent(share, 6))
    figure = f"at least {percent(share, 6)}; {percent(proof.undecided, 6)} is undecided"
    return _row(_worth(share > 0), TRUE, claim, figure)


def _proof(result: Result, proof: Proof | None) -> Iterator[ClaimRow]:
    if proof is None:
        if result.verified and not isinstance(result.problem.system, MatrixSystem):
            yield _row(UNKNOWN, TRUE, "What share of the stabilizable set arrives for certain",
                       "not asked for: lmdsl prove")  # fmt: skip
        return
    share = proof.stays if proof.to_stay else proof.arrives
    word = "stays for ever" if proof.to_stay else "arrives in A"
    yield _share(proof, f"Share of the volume of the stabilizable set that {word}", share)
    yield _share(proof, "Share that is lost", proof.lost)
    if not proof.to_stay:
        yield _share(proof, "Share that stays elsewhere", proof.stays)
    yield _row(OPEN, TRUE, "Share that is undecided", percent(proof.undecided, 6))
    if proof.cost is not None:
        low, high = (_known(x, 6) for x in proof.cost)
        yield _row(PROVED, TRUE, f"What arrives does so in at most {proof.steps} steps, at a mean "
                   "cost between", f"{low} and {high}")  # fmt: skip
    if proof.optimum is not None:
        low, high = (_known(x, 6) for x in proof.optimum)
        worth = PROVED if proof.nonnegative else ASSUMED
        yield _row(worth, TRUE, "What any law with these control values costs there, at least",
                   f"{low} (this one at most {high})")  # fmt: skip
    if proof.probability is not None:
        yield _row(PROVED, TRUE, "A run with its noise arrives with a probability of at least",
                   number(proof.probability, 6))  # fmt: skip
    if not proof.to_stay:
        worth = {True: PROVED, False: REFUTED, None: OPEN}[proof.holds]
        yield _row(worth, TRUE, "What arrives stays in A from then on", "")
