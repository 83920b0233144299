#!/usr/bin/env python3
"""Check a certificate that lmdsl exported. Needs nothing but Python, and no part of lmdsl.

    python3 check_certificate.py FILE

The file describes a Markov decision process and claims something about it: one JSON value per line,
every double in hexadecimal, so that it is read without any rounding.

  line 1      the head: gamma, the numbers n of cells and K of pairs, `total`, what is claimed
  n lines     cell i = 0, ..., n-1: m (its weight), policy (its control), V_up, W, w, mu
  K lines     [i, control, cost, [[j, c], ...]]: in cell i this control costs `cost` and leads to
              cell j with probability c/total; j = n is the attractor, where all cost ends, and
              j = n + 1 the end of the run (a discount). Without a total in the head every line
              has its own, after the row

Write P_a x for the expected value of x after the pair a, with x = 0 in the attractor and where the
run ends, and P_u for the pairs of the policy u; g = max(gamma, 1). A policy comes with the claims

  1 stabilizing   w > 0 and w > g P_u w: the spectral radius of g P_u is below 1, so the attractor
                  (or the end) is reached almost surely from every cell
  2 upper bound   V_up >= 0 and V_up >= gamma P_u V_up + cost: the policy costs at most m'V_up
  3 lower bound   W >= 0 and W <= gamma P_a W + cost for ALL pairs a: no policy costs less than m'W
  4 measure       mu >= 0 and ||m - mu + gamma P_u' mu||_1 <= 1e-9 max(1, ||mu||_1)
  5 gap           (m'V_up - m'W) / m'V_up <= tolerance; that of the stated two if cost < 2^-1022

and a refusal with

  6 refusal       w >= 0, w != 0 and w <= gamma P_a w for ALL pairs a: no policy has a finite
                  weighted occupation from the cells with w > 0

Where the head says what the map is (`map`), a policy also comes with

  7 safe          no run of the map itself from C is lost: see claim_7/judge.py beside this file

Claims 1 to 6 are decided with rational numbers, claim 7 in arithmetic rounded outward. Exit
status: 0 if every claim holds, 1 if one fails, 2 if the file is no certificate. What is not checked
here: that this process, or this map, is that of some problem (`lmdsl verify` recompiles it;
model_sha256 names it).
"""

import json
import math
import os
import sys
from decimal import Decimal
from fractions import Fraction

FINE = Fraction(1, 2**4000)
NAMES = {1: "stabilizing", 2: "upper bound", 3: "lower bound", 4: "measure", 5: "gap", 6: "refusal",
         7: "safe"}  # fmt: skip


def need(condition, message):
    """Stop unless the file is as described above."""
    if not condition:
        raise ValueError(message)


def whole(value, low, high):
    """Say whether a JSON value is an integer with low <= value < high."""
    return type(value) is int and low <= value < high


def shown(value, digits=17):
    """Write a fraction of any size."""
    return f"{Decimal(value.numerator) / value.denominator:.{digits}g}"


def read_pairs(lines, n, K, common, targets):
    """Yield (i, control, cost, row, total) for each of the K pairs; every cell must have one."""
    last = (-1, -1)
    for k in range(K):
        i, control, cost, row, *own = json.loads(next(lines))
        need(len(own) == (common is None), f"pair {k}: no total, or one too many")
        (total,) = own or [common]
        need(whole(total, 1, math.inf), f"pair {k}: the total is not an integer >= 1")
        need(whole(i, 0, n) and whole(control, 0, 2**31), f"pair {k}: no such cell or control")
        # By cell, then control: no pair twice, and no cell left out.
        need(last < (i, control) and i <= last[0] + 1, f"pair {k} is out of order")
        last = (i, control)
        cost = float.fromhex(cost)
        need(0 <= cost < math.inf, f"pair {k}: the cost is not a finite number >= 0")
        need(all(whole(j, 0, targets) for j, _ in row), f"pair {k}: no such target")
        need(all(whole(c, 1, total + 1) for _, c in row), f"pair {k}: no such probability")
        need(sum(c for _, c in row) == total, f"pair {k}: the probabilities do not sum to 1")
        yield i, control, Fraction(cost), row, total
    need(last[0] == n - 1, "a cell has no pair")
    need(next(lines, None) is None, "there are more pairs than the head says")


def check(lines):
    """Return ({claim: why it fails, or None}, sentences that state the numbers)."""
    head = json.loads(next(lines))
    need(head["format"] == "lmdsl-certificate/1", "the format is not lmdsl-certificate/1")
    need(head["kind"] in ("policy", "refusal"), "the kind is neither policy nor refusal")
    n, K, total = head["cells"], head["pairs"], head["total"]
    need(all(whole(size, 1, math.inf) for size in (n, K)), "a size is not an integer >= 1")
    gamma = float.fromhex(head["gamma"])
    need(0 < gamma < math.inf, "gamma is not a finite number > 0")
    cells = [json.loads(next(lines)) for _ in range(n)]
    pairs = read_pairs(lines, n, K, total, n + 1 + ("discount" in head))
    refusal = head["kind"] == "refusal"
    judge = check_refusal if refusal else check_policy
    verdict, numbers = judge(head, cells, pairs, Fraction(gamma))
    if "map" in head and not refusal:
        sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
        from claim_7 import judge as safety

        verdict[7], said = safety.check(head["map"], cells)
        numbers += said
    return verdict, [*numbers, *(f"assumed: {head[key]!a}" for key in head if key == "assumes")]


def vector(cells, name, verdict, claim, positive=False):
    """Return integers X and a power of two D with x = X/D exactly, and 0 for attractor and end.

    Where a number has the wrong sign or is not finite, the claim fails.
    """
    x = [float.fromhex(cell[name]) for cell in cells]
    bad = [i for i, v in enumerate(x) if not (0 <= v < math.inf and (v > 0 or not positive))]
    if bad:
        wanted = "> 0" if positive else ">= 0"
        verdict[claim] = f"{name} of cell {bad[0]} is not a finite number {wanted}"
        return [0] * (len(x) + 2), 1
    ratios = [v.as_integer_ratio() for v in x]
    D = max(denominator for _, denominator in ratios)
    return [numerator * (D // denominator) for numerator, denominator in ratios] + [0, 0], D


def check_refusal(head, cells, pairs, gamma):
    """Claim 6; gamma * sum(c * w_j) / total is gamma P_a w."""
    verdict = {6: None}
    w, _ = vector(cells, "w", verdict, 6)
    count = sum(value > 0 for value in w)
    if not count and not verdict[6]:
        verdict[6] = "w is 0 everywhere"
    for i, control, _, row, total in pairs:
        if not w[i] <= gamma * sum(c * w[j] for j, c in row) / total:
            verdict[6] = verdict[6] or f"w > gamma P_a w in cell {i}, control {control}"
    return verdict, [f"w > 0 in {count} of {len(cells)} cells"]


def check_policy(head, cells, pairs, gamma):
    """Claims 1 to 5."""
    n, verdict, g = len(cells), dict.fromkeys(range(1, 6)), max(gamma, Fraction(1))

    def fail(claim, why):
        verdict[claim] = verdict[claim] or why

    w, _ = vector(cells, "w", verdict, 1, positive=True)
    V_up, D_V = vector(cells, "V_up", verdict, 2)
    W, D_W = vector(cells, "W", verdict, 3)
    mu, D_mu = vector(cells, "mu", verdict, 4)
    m, D_m = vector(cells, "m", verdict, 4)
    found, least = 0, Fraction(1)  # cells whose policy is a pair; min of (w - g P_u w)/w
    inflow = [{} for _ in range(n + 2)]  # P_u' mu times D_mu, its numerator by total
    for i, control, cost, row, total in pairs:
        # Claim 3 ranges over all pairs: this is where a better policy would show.
        if not W[i] <= gamma * sum(c * W[j] for j, c in row) / total + cost * D_W:
            fail(3, f"W > gamma P_a W + cost in cell {i}, control {control}")
        if control != cells[i]["policy"]:
            continue
        found += 1  # controls ascend within a cell, so at most one pair of a cell comes here
        if not verdict[1]:
            decrease = w[i] - g * sum(c * w[j] for j, c in row) / total
            least = min(least, decrease / w[i])
            if not decrease > 0:
                fail(1, f"w <= g P_u w in cell {i}")
        if not V_up[i] >= gamma * sum(c * V_up[j] for j, c in row) / total + cost * D_V:
            fail(2, f"V_up < gamma P_u V_up + cost in cell {i}")
        for j, c in row:
            inflow[j][total] = inflow[j].get(total, 0) + c * mu[i]  # claim 4
    need(found == n, "the policy of a cell is no pair of the file")
    need(abs(Fraction(sum(m), D_m) - 1) <= 1e-9, "m does not sum to 1")
    arrives = (sum(Fraction(x, total) for total, x in inflow[i].items()) for i in range(n))
    left = (abs(Fraction(m[i], D_m) - (mu[i] - gamma * x) / D_mu) for i, x in enumerate(arrives))
    if head["total"] is None:  # rounded up to multiples of FINE: else the sum has too many digits
        left = (-(-x // FINE) * FINE for x in left)
    residual = sum(left)
    if not residual <= Fraction(1e-9) * max(1, Fraction(sum(mu), D_mu)):
        fail(4, f"the residual is {shown(residual, 3)}, above 1e-9 max(1, sum of mu)")
    cost = Fraction(sum(a * b for a, b in zip(m, V_up, strict=True)), D_m * D_V)
    lower = Fraction(sum(a * b for a, b in zip(m, W, strict=True)), D_m * D_W)
    gap = (cost - lower) / cost if cost else Fraction(0)
    # The numbers stated in the head: the upper ones may be too high, the lower one too low.
    for claim, name, value, sign in (
        (1, "contraction", 1 - least, 1), (2, "cost", cost, 1), (3, "lower_bound", lower, -1),
    ):  # fmt: skip
        stated = head[name]
        if stated is None or not sign * Fraction(float.fromhex(stated)) >= sign * value:
            fail(claim, f"{name} is stated as {stated}, but is {shown(value)}")
    if verdict[2] or verdict[3]:
        fail(5, "there is no gap without both bounds")
    elif 0 < float.fromhex(head["cost"]) < sys.float_info.min:
        cost, lower = (Fraction(float.fromhex(head[name])) for name in ("cost", "lower_bound"))
        gap = max(gap, (cost - lower) / cost)
    if not gap <= float.fromhex(head["tolerance"]):  # a comparison with a double is exact
        fail(5, f"the gap {shown(gap, 3)} is above the tolerance")
    return verdict, [
        f"cost m'V_up {shown(cost)}, lower bound m'W {shown(lower)}, gap {shown(gap, 3)}",
        f"contraction {shown(1 - least)}, residual of the measure {shown(residual, 3)}",
    ]


def main(arguments):
    """Check one file, print the verdicts and return the exit status."""
    try:
        (path,) = arguments
        with open(path, encoding="ascii") as lines:
            verdict, numbers = check(lines)
    except Exception as error:  # whatever a file may hold
        print(f"not a certificate: {type(error).__name__}: {error}")
        return 2
    for claim, why in verdict.items():
        print(f"claim {claim} {NAMES[claim]}: " + (f"FAILS: {why}" if why else "holds"))
    print(*numbers, sep="\n")
    return 1 if any(verdict.values()) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
