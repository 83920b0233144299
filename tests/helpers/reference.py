"""An independent, plain and slow reference: from a problem file to the optimal values.

Written from the documentation of the problem format only; it shares no code with the library and
does not import it. It favours being obviously right over being fast: formulas are evaluated by
Python one sample at a time, transitions are exact fractions, linear algebra is dense.

    model = compile_reference(problem)      # the finite model: rows, costs, causes
    solution = solve_reference(model)       # optimal values, one optimal policy, ties, gamma_bar

Only for trusted input: a formula is handed to Python's `eval`. The input is assumed to be valid.
"""

import ast
import itertools
import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from reference_steps import integral, journey, knots
from scipy.stats import qmc

ATTRACTOR, STABILIZED, ESCAPES, TRAPPED, LEADS, AVOID = range(6)
EDGE = 1e-9
TURNS = 2.0**20  # in cell widths: how close to an edge counts as on it

STANDARD_MAP = {"x": "x + y + K*u*sin(2*pi*x)", "y": "y + K*u*sin(2*pi*x)"}

Pair = tuple[int, int]  # (cell, control index)


# ---------------------------------------------------------------------------------------- formulas

FUNCTIONS = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "atan2": np.arctan2,
    "min": np.minimum,
    "max": np.maximum,
    "mod": np.mod,
    "where": lambda condition, yes, no: yes if condition else no,
    "pi": np.float64(math.pi),
    "e": np.float64(math.e),
    "__builtins__": {},
    "__float64": np.float64,
}


class _Float64Literals(ast.NodeTransformer):
    """Make every number in a formula a float64, so that 1/0 is inf and (-1)**0.5 is NaN."""

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        name = ast.Name(id="__float64", ctx=ast.Load())
        return ast.copy_location(ast.Call(func=name, args=[node], keywords=[]), node)


def formula(text: str) -> Callable[[dict[str, np.float64]], float]:
    """Text -> function of the values of its names."""
    tree = _Float64Literals().visit(ast.parse(text.strip(), mode="eval"))
    code = compile(ast.fix_missing_locations(tree), text, "eval")

    def value(names: dict[str, np.float64]) -> np.float64:
        with np.errstate(all="ignore"):
            return eval(code, FUNCTIONS, names)

    return value


def parameters_of(problem: dict[str, Any]) -> dict[str, np.float64]:
    """The parameters of the system by name, defaults included."""
    system = problem["system"]
    defaults = {"K": 0.25} if system["kind"] == "standard_map" else {}
    given = {**defaults, **system.get("parameters", {})}
    return {name: np.float64(value) for name, value in given.items()}


def value_of(problem: dict[str, Any], text: str) -> Callable[[dict[str, float]], float]:
    """Formula or condition of a problem -> function of the values of states, controls, noise.

    What `let` defines is evaluated first, in order, as far as its names have values.
    """
    parameters = parameters_of(problem)
    definitions = {name: formula(by) for name, by in (problem.get("let") or {}).items()}
    own = formula(text)

    def value(names: dict[str, float]) -> float:
        values = {**parameters, **{k: np.float64(v) for k, v in names.items()}}
        for name, by in definitions.items():
            try:
                values[name] = by(values)
            except NameError:
                continue
        return float(own(values))

    return value


# ---------------------------------------------------------------------------------------- geometry


@dataclass(frozen=True)
class Axis:
    """One state and its cells."""

    name: str
    low: float
    high: float
    cells: int
    periodic: bool

    @property
    def width(self) -> float:
        return (self.high - self.low) / self.cells

    def scaled(self, value: float) -> float:
        """Position counted in cell widths from `low`."""
        return (value - self.low) / self.width

    def wrapped(self, value: float) -> float | None:
        """The place on a circle of a number, None if it is not finite or too many turns away."""
        span = self.high - self.low
        away = value - self.low
        if not abs(away / span) <= TURNS + 1:
            return None
        turns = math.floor(away / span)
        if self.low <= value <= self.high:
            return value
        place = self.low + min(max(away - turns * span, 0.0), span)
        return min(place, self.high) if abs(turns) <= TURNS else None

    def cell_of(self, value: float) -> int | None:
        """Cell of an image, None if it is outside."""
        if self.periodic:
            place = self.wrapped(value)
            return None if place is None else math.floor(self.scaled(place) + EDGE) % self.cells
        t = self.scaled(value)
        if not math.isfinite(t):
            return None
        k = math.floor(t + EDGE)
        if abs(t - self.cells) <= EDGE or (k == self.cells and value <= self.high):
            return self.cells - 1
        return k if 0 <= k < self.cells else None

    def touched_by(self, value: float) -> list[int]:
        """Every closed cell within EDGE widths of a point."""
        t = self.scaled(value)
        images = [t]
        if self.periodic:
            place = self.wrapped(value)
            t = math.nan if place is None else self.scaled(place)
            images = [t - self.cells, t, t + self.cells]
        return [i for i in range(self.cells) if any(i - EDGE <= s <= i + 1 + EDGE for s in images)]

    def inside(self, a: float, b: float) -> list[int]:
        """The cells inside [a, b], up to EDGE widths."""
        ta, tb = self.scaled(a), self.scaled(b)
        return [i for i in range(self.cells) if ta - EDGE <= i and i + 1 <= tb + EDGE]

    def overlapped(self, a: float, b: float) -> list[int]:
        """The cells whose interior overlaps [a, b] by more than EDGE widths."""
        ta, tb = self.scaled(a), self.scaled(b)
        return [i for i in range(self.cells) if min(i + 1, tb) - max(i, ta) > EDGE]


def number_of_cells(axes: list[Axis]) -> int:
    return math.prod(axis.cells for axis in axes)


def flat(axes: list[Axis], index: Iterable[int]) -> int:
    """Multi-index -> cell number (C order, last axis fastest)."""
    number = 0
    for axis, i in zip(axes, index, strict=True):
        number = number * axis.cells + i
    return number


def unflat(axes: list[Axis], number: int) -> tuple[int, ...]:
    """Cell number -> multi-index."""
    index: list[int] = []
    for axis in reversed(axes):
        number, i = divmod(number, axis.cells)
        index.append(i)
    return tuple(reversed(index))


def _product_cells(axes: list[Axis], per_axis: list[list[int]]) -> set[int]:
    return {flat(axes, index) for index in itertools.product(*per_axis)}


def cells_inside(axes: list[Axis], box: dict[str, list[float]]) -> set[int]:
    """Cells inside a box; an axis that the box leaves out is unrestricted."""
    return _product_cells(
        axes, [a.inside(*box[a.name]) if a.name in box else list(range(a.cells)) for a in axes]
    )


def cells_overlapped(axes: list[Axis], box: dict[str, list[float]]) -> set[int]:
    """Cells whose interior a box overlaps."""
    return _product_cells(
        axes, [a.overlapped(*box[a.name]) if a.name in box else list(range(a.cells)) for a in axes]
    )


def conditions_of(problem: dict[str, Any], key: str) -> list[str]:
    """The conditions under `where`, a text or a list of texts."""
    where = (problem.get(key) or {}).get("where", [])
    return [where] if isinstance(where, str) else where


def cells_where(problem: dict[str, Any], text: str, everywhere: bool) -> set[int]:
    """Cells on which a condition holds: at all of many points, the corners among them, or at one.

    A cell is judged without EDGE widths at each side. The points decide for a set that is convex
    (everywhere), and for one whose complement is convex (somewhere); for others only nearly.
    """
    axes = read_axes(problem)
    holds = value_of(problem, text)
    per_axis = 9 if len(axes) == 1 else 5
    found = set()
    for number in range(number_of_cells(axes)):
        ends = [
            (a.low + (i + EDGE) * a.width, a.low + (i + 1 - EDGE) * a.width)
            for a, i in zip(axes, unflat(axes, number), strict=True)
        ]
        points = itertools.product(*(np.linspace(*end, per_axis) for end in ends))
        names = [axis.name for axis in axes]
        held = (holds(dict(zip(names, point, strict=True))) for point in points)
        if all(held) if everywhere else any(held):
            found.add(number)
    return found


def read_axes(problem: dict[str, Any]) -> list[Axis]:
    return [
        Axis(name, float(a["low"]), float(a["high"]), int(a["cells"]), a.get("periodic", False))
        for name, a in problem["state_box"].items()
    ]


def attractor_cells(problem: dict[str, Any]) -> set[int]:
    axes = read_axes(problem)
    where = problem["attractor"]
    found: set[int] = set()
    for point in where.get("points", []):
        values = [point[a.name] for a in axes] if isinstance(point, dict) else point
        touched = [a.touched_by(v) for a, v in zip(axes, values, strict=True)]
        found |= _product_cells(axes, touched)
    for box in where.get("boxes", []):
        found |= cells_inside(axes, box)
    for index in where.get("cells", []):
        found.add(flat(axes, index))
    for text in conditions_of(problem, "attractor"):
        found |= cells_where(problem, text, everywhere=True)
    return found


def avoid_cells(problem: dict[str, Any]) -> set[int]:
    axes = read_axes(problem)
    found: set[int] = set()
    for box in problem.get("avoid", {}).get("boxes", []):
        found |= cells_overlapped(axes, box)
    for text in conditions_of(problem, "avoid"):
        found |= cells_where(problem, text, everywhere=False)
    return found


def measure_cells(problem: dict[str, Any]) -> set[int] | None:
    """Cells in the sets of `measure`; None if the problem has no `measure`."""
    if problem.get("measure") is None:
        return None
    axes = read_axes(problem)
    found: set[int] = set()
    for box in problem["measure"].get("boxes", []):
        found |= cells_inside(axes, box)
    for text in conditions_of(problem, "measure"):
        found |= cells_where(problem, text, everywhere=True)
    return found


# ----------------------------------------------------------------- controls, noise, sample points


def control_vectors(problem: dict[str, Any]) -> list[tuple[float, ...]]:
    """Every control vector in C order; the empty tuple alone for an autonomous system."""
    lists = []
    for grid in problem["control_grid"].values():
        if "values" in grid:
            lists.append([float(v) for v in grid["values"]])
        else:
            lists.append([float(v) for v in np.linspace(grid["low"], grid["high"], grid["points"])])
    return list(itertools.product(*lists))


def noise_nodes(problem: dict[str, Any]) -> list[tuple[tuple[float, ...], float]]:
    """(values, weight) of every joint noise node in C order; one empty node without noise."""
    per_variable = []
    for spec in problem.get("noise", {}).values():
        if "normal" in spec:
            x, w = np.polynomial.hermite.hermgauss(spec["normal"]["points"])
            values = [math.sqrt(2.0) * spec["normal"]["std"] * float(v) for v in x]
            weights = [float(v) for v in w]
        elif "uniform" in spec:
            low, high, k = (spec["uniform"][key] for key in ("low", "high", "points"))
            values = [low + (i + 0.5) / k * (high - low) for i in range(k)]
            weights = [1.0 / k] * k
        else:
            values = [float(v) for v in spec["values"]]
            weights = [float(v) for v in spec["weights"]]
        total = math.fsum(weights)
        nodes = [(v, w / total) for v, w in zip(values, weights, strict=True) if w > 0]
        per_variable.append(nodes)
    joint = []
    for combination in itertools.product(*per_variable):
        weight = 1.0
        for _, w in combination:
            weight *= w
        joint.append((tuple(v for v, _ in combination), weight))
    return joint


def sample_offsets(problem: dict[str, Any]) -> list[tuple[float, ...]]:
    """Offsets of the sample points, in cell widths, the same in every cell."""
    axes = list(problem["state_box"])
    sampling = problem["sampling"]
    seed = sampling.get("seed", 0)
    if sampling["kind"] == "grid":
        k = sampling["per_axis"]
        each = [k[name] if isinstance(k, dict) else k for name in axes]
        points = list(itertools.product(*([(i + 0.5) / n for i in range(n)] for n in each)))
    elif sampling["kind"] == "random":
        points = np.random.default_rng(seed).random((sampling["points"], len(axes))).tolist()
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SciPy warns unless the number is a power of two
            drawn = qmc.Sobol(len(axes), scramble=True, seed=seed).random(sampling["points"])
        points = drawn.tolist()
    if sampling.get("corners", False):
        points += list(itertools.product([0.0, 1.0], repeat=len(axes)))
    return [tuple(float(v) for v in point) for point in points]


def sample_of(axis: Axis, index: int, offset: float) -> float:
    """Coordinate of a sample point; the upper corner of the last cell is the end of the axis."""
    if offset == 1 and index == axis.cells - 1:
        return axis.high
    return axis.low + (index + offset) * axis.width


# ---------------------------------------------------------------------------------------- dynamics


def next_state_function(problem: dict[str, Any]) -> Callable[[dict[str, float]], list[float]]:
    """Make the function (values of every state, control, noise variable) -> image."""
    system = problem["system"]
    states = list(problem["state_box"])
    evaluate = right_hand_side(problem)
    if system["kind"] != "ode":
        return evaluate

    def runge_kutta(names: dict[str, float]) -> list[float]:
        def slope(x: list[float]) -> list[float]:
            return evaluate({**names, **dict(zip(states, x, strict=True))})

        start = [float(names[s]) for s in states]
        return knots(slope, start, system["step"], system.get("substeps", 1))[0][-1]

    return runge_kutta


def right_hand_side(problem: dict[str, Any]) -> Callable[[dict[str, float]], list[float]]:
    """Make the function of the formulas of a map, or of the derivatives."""
    system = problem["system"]
    states = list(problem["state_box"])
    if system["kind"] == "standard_map":
        texts = STANDARD_MAP
    elif system["kind"] == "map":
        texts = system["next"]
    else:
        texts = system["derivative"]
    formulas = [value_of(problem, texts[s]) for s in states]

    def evaluate(names: dict[str, float]) -> list[float]:
        return [f(names) for f in formulas]

    return evaluate


def step_function(
    problem: dict[str, Any], axes: list[Axis], A: set[int], Z: set[int]
) -> Callable[[dict[str, float]], tuple[int | str, float]]:
    """Make the function (values of all names) -> where the sample ends, and what it costs."""
    system, clip = problem["system"], problem.get("on_exit", "forbid") == "clip"
    ode = system["kind"] == "ode"
    path = ode and system.get("judged", "path") == "path"
    image, derivative = next_state_function(problem), right_hand_side(problem)
    rate = formula_of(problem, "cost_rate")
    stage_cost, terminal = formula_of(problem, "stage_cost"), formula_of(problem, "terminal_cost")
    widths, states = [a.width for a in axes], [a.name for a in axes]

    def where(place: list[float], final: bool) -> int | str | None:
        cell = cell_of_image(axes, place, clip and final)
        if cell is None:
            return None if clip and not final else "escaped"
        if cell in Z or cell in A:
            return "escaped" if cell in Z else "absorbed"
        return cell if final else None

    def at_end(place: list[float], final: bool) -> int | str | None:
        return where(place, final) if final else None

    def step(names: dict[str, float]) -> tuple[int | str, float]:
        cost = stage_cost(names) if stage_cost else 0.0
        if not ode:
            place = image(names)
            key = where(place, True)
        else:

            def slope(x: list[float]) -> list[float]:
                here = {**names, **dict(zip(states, x, strict=False))}
                more = [rate(here)] if rate else []
                return [*derivative(here), *more]

            start = [float(names[s]) for s in states] + [0.0] * bool(rate)
            found = knots(slope, start, system["step"], system.get("substeps", 1))
            key, s, t, place = journey(*found[:2], widths, where if path else at_end)
            if rate:
                cost = integral(found[0], found[2], place, s, t)
        if key == "absorbed" and terminal:
            state = [
                a.wrapped(x) if a.periodic else min(max(x, a.low), a.high) if clip else x
                for a, x in zip(axes, place, strict=False)
            ]
            later = problem.get("gamma", 1.0) * problem.get("discount", 1.0)
            cost += later * terminal(dict(zip(states, state, strict=True)))
        return key, cost

    return step


def formula_of(problem: dict[str, Any], key: str) -> Callable[[dict[str, float]], float] | None:
    """Make the function of the values of all names that a key holds; None without the key."""
    return value_of(problem, problem[key]) if key in problem else None


def cell_of_image(axes: list[Axis], image: list[float], clip: bool) -> int | None:
    """Cell of an image, None if it leaves the box (before `avoid` is looked at)."""
    if not all(math.isfinite(v) for v in image):
        return None
    index = []
    for axis, v in zip(axes, image, strict=True):
        if clip and not axis.periodic:
            v = min(max(v, axis.low), axis.high)
        i = axis.cell_of(v)
        if i is None:
            return None
        index.append(i)
    return flat(axes, index)


# ---------------------------------------------------------------------------------------- the model

Row = tuple[dict[int, Fraction], Fraction, Fraction]


@dataclass
class ReferenceModel:
    """The finite model of a problem. A pair is (cell, control index)."""

    problem: dict[str, Any]
    axes: list[Axis]
    controls: list[tuple[float, ...]]
    N: int
    M: int
    S: int  # sample points times noise nodes of positive weight
    points: int
    noise: list[tuple[tuple[float, ...], float]]
    attractor: set[int]
    avoid: set[int]
    # pair -> {target cell, "absorbed" or "escaped": number of sample points for each noise node}
    counts: dict[Pair, dict[int | str, list[int]]]
    # pair -> ({target cell outside A: share}, share absorbed, share escaped), exact, sum 1; with a
    # discount b the sum is b, and with the rest the run ends
    rows: dict[Pair, Row]
    admissible: set[Pair]
    cost: dict[Pair, float]  # of every admissible pair
    cell_status: list[int] = field(default_factory=list)
    surviving: list[Pair] = field(default_factory=list)
    m: dict[int, float] = field(default_factory=dict)
    discount: Fraction = Fraction(1)
    _gamma_bar: Any = None

    @property
    def ends(self) -> bool:
        """Whether every run ends by discount so soon that its cost is finite."""
        return self.discount < 1 and Fraction(self.problem.get("gamma", 1.0)) * self.discount < 1

    @property
    def C(self) -> list[int]:
        return [c for c, status in enumerate(self.cell_status) if status == STABILIZED]


def compile_reference(problem: dict[str, Any]) -> ReferenceModel:
    """Sample every pair outside A and Z, sort its samples into cells, and find C and the causes."""
    axes = read_axes(problem)
    controls = control_vectors(problem)
    offsets = sample_offsets(problem)
    noise = noise_nodes(problem)
    A, Z = attractor_cells(problem), avoid_cells(problem)
    if A & Z or not (A or ("discount" in problem and not problem["attractor"])):
        raise ValueError("no attractor cell, or a cell that is both attractor and avoid")
    step = step_function(problem, axes, A, Z)
    admissible = value_of(problem, problem.get("admissible", "0 == 0"))
    N = number_of_cells(axes)

    model = ReferenceModel(
        problem=problem,
        axes=axes,
        controls=controls,
        N=N,
        M=len(controls),
        S=len(offsets) * len(noise),
        points=len(offsets),
        noise=noise,
        attractor=A,
        avoid=Z,
        counts={},
        rows={},
        admissible=set(),
        cost={},
        discount=Fraction(float(problem.get("discount", 1))),
    )
    for cell in range(N):
        if cell in A or cell in Z:
            continue
        corner = unflat(axes, cell)
        samples = [
            [sample_of(a, i, o) for a, i, o in zip(axes, corner, offset, strict=True)]
            for offset in offsets
        ]
        for number, control in enumerate(controls):
            pair = (cell, number)
            count: dict[int | str, list[int]] = {}
            costs = []
            for x in samples:
                for node, (w, _) in enumerate(noise):
                    names = _names(problem, x, control, w)
                    key, cost = step(names)
                    key = key if admissible(names) else "escaped"
                    count.setdefault(key, [0] * len(noise))[node] += 1
                    costs.append(cost)
            model.counts[pair] = count
            row = _shares(count, [w for _, w in noise], len(offsets))
            model.rows[pair] = _discounted(row, model.discount)
            if "escaped" not in count:
                model.admissible.add(pair)
                model.cost[pair] = _mean_cost(model, pair, costs)
    _classify(model)
    return model


def _names(problem: dict, x: list[float], u: tuple, w: tuple) -> dict[str, float]:
    """Put the values of states, controls and noise variables beside their names."""
    names = dict(zip(problem["state_box"], x, strict=True))
    names.update(zip(problem["control_grid"], u, strict=True))
    names.update(zip(problem.get("noise", {}), w, strict=True))
    return names


def _shares(count: dict, weights: list[float], points: int) -> Row:
    """Turn counts per noise node into exact shares of the whole weight."""
    exact = [Fraction(w) for w in weights]
    whole = points * sum(exact)
    share = {}
    for key, numbers in count.items():
        share[key] = sum(n * w for n, w in zip(numbers, exact, strict=True)) / whole
    absorbed = share.pop("absorbed", Fraction(0))
    escaped = share.pop("escaped", Fraction(0))
    return share, absorbed, escaped


def _discounted(row: Row, b: Fraction) -> Row:
    targets, absorbed, escaped = row
    return {t: b * share for t, share in targets.items()}, b * absorbed, b * escaped


def _mean_cost(model: ReferenceModel, pair: Pair, costs: list[float]) -> float:
    """Weighted mean of the costs of the samples, by sample point, then noise node."""
    for g in costs:
        if not (math.isfinite(g) and g >= 0):
            raise ValueError(f"the cost is {g} at cell {pair[0]}, control {pair[1]}")
    weights = [weight for _, weight in model.noise]
    terms = [weight * g for weight, g in zip(weights * model.points, costs, strict=True)]
    return math.fsum(terms) / (model.points * math.fsum(weights))


def _can_reach(model: ReferenceModel, pairs: Iterable[Pair]) -> set[int]:
    """Cells from which A is reached with positive probability through the given pairs.

    Where runs end by discount in time, their end is as good as A.
    """
    pairs = list(pairs)
    if model.ends:
        return {cell for cell, _ in pairs}
    reached: set[int] = set()
    while True:
        more = {
            cell
            for cell, control in pairs
            if cell not in reached and _reaches_in_one(model.rows[cell, control], reached)
        }
        if not more:
            return reached
        reached |= more


def _reaches_in_one(row: Row, reached: set[int]) -> bool:
    targets, absorbed, _ = row
    return absorbed > 0 or any(t in reached for t in targets)


def surely_reaching(model: ReferenceModel, pairs: Iterable[Pair]) -> tuple[set[int], set[Pair]]:
    """Greatest set of cells that can stay in it until A, from all of which A is reached.

    Returned with the given pairs of its cells whose successors are all in the set or in A.
    """
    keep = set(pairs)
    cells = {cell for cell, _ in keep}
    while True:
        keep = {p for p in keep if p[0] in cells and all(t in cells for t in model.rows[p][0])}
        good = _can_reach(model, keep)
        if good == cells:
            return cells, keep
        cells = good


def _classify(model: ReferenceModel) -> None:
    """Fill in cell_status, surviving and m."""
    C, surviving = surely_reaching(model, model.admissible)
    reach = _can_reach(model, model.admissible)
    some_pair = {cell for cell, _ in model.admissible}
    for cell in range(model.N):
        if cell in model.attractor:
            status = ATTRACTOR
        elif cell in model.avoid:
            status = AVOID
        elif cell in C:
            status = STABILIZED
        elif cell not in some_pair:
            status = ESCAPES
        elif cell not in reach:
            status = TRAPPED
        else:
            status = LEADS
        model.cell_status.append(status)
    model.surviving = sorted(surviving)
    wanted = measure_cells(model.problem)
    support = sorted(C if wanted is None else C & wanted)
    model.m = {c: 1.0 / len(support) for c in support}


# ------------------------------------------------------------------------------------------ solving


@dataclass
class ReferenceSolution:
    """Optimal values. V, policy and ties are empty when nothing was solved."""

    status: str  # "ok" or "not_stabilizable"
    gamma: float
    gamma_bar: tuple[float, float] | None  # proved bracket; None if C is empty
    decided: bool  # False: gamma lies inside the bracket, so that the status is only a guess
    V: dict[int, float] = field(default_factory=dict)
    policy: dict[int, int] = field(default_factory=dict)
    ties: dict[int, set[int]] = field(default_factory=dict)  # within 1e-9 relative of optimal
    cost: float | None = None  # m'V
    policy_reaches: bool = False  # the policy given reaches A from all of C (can fail if gamma < 1)
    tied_policy_reaches: bool = False  # some policy within `ties` does


class _Arrays:
    """The surviving pairs as dense arrays: P (K, n), G (K,), and the pairs of every cell."""

    def __init__(self, model: ReferenceModel):
        self.model = model
        self.cells = model.C
        self.index = {c: i for i, c in enumerate(self.cells)}
        self.pairs = model.surviving
        self.n, self.K = len(self.cells), len(self.pairs)
        self.P = np.zeros((self.K, self.n))
        self.G = np.array([model.cost[p] for p in self.pairs])
        self.choices: list[list[int]] = [[] for _ in self.cells]
        for k, pair in enumerate(self.pairs):
            self.choices[self.index[pair[0]]].append(k)
            for target, share in model.rows[pair][0].items():
                self.P[k, self.index[target]] = float(share)

    def exact(self, k: int, w: list[Fraction]) -> Fraction:
        """(P w)[k] in exact arithmetic."""
        row = self.model.rows[self.pairs[k]][0]
        return sum((share * w[self.index[t]] for t, share in row.items()), Fraction(0))


def communicating_classes(P: np.ndarray) -> list[np.ndarray]:
    """Sort cells into classes that reach each other; a class stands after those it leads to."""
    R = (P > 0) | np.eye(len(P), dtype=bool)
    while True:  # the transitive closure
        more = (R.astype(float) @ R.astype(float)) > 0
        if np.array_equal(more, R):
            break
        R = more
    both = R & R.T
    first = [i for i in range(len(P)) if not both[i, :i].any()]
    first.sort(key=lambda i: int(R[i].sum()))  # who leads to another class reaches more cells
    return [np.flatnonzero(both[i]) for i in first]


def policy_value(
    P: np.ndarray, G: np.ndarray, gamma: float, classes: list[np.ndarray] | None = None
) -> np.ndarray:
    """Solve V = G + gamma P V class by class; exactly zero where no cost can ever be met."""
    V = np.zeros(len(G))
    with np.errstate(all="ignore"):
        for at in communicating_classes(P) if classes is None else classes:
            right = G[at] + gamma * (P[at] @ V)  # V is still zero on the class itself
            if not right.any():
                continue
            if len(at) == 1:
                V[at] = right / (1.0 - gamma * P[at, at])
                continue
            inside = P[np.ix_(at, at)]
            matrix = np.eye(len(at)) - gamma * inside
            try:
                inverse = np.linalg.inv(matrix)
                v = inverse @ right
                for _ in range(3):  # iterative refinement, residual in long double
                    long = v.astype(np.longdouble)
                    image = np.longdouble(gamma) * (inside.astype(np.longdouble) @ long)
                    residual = (right - (long - image)).astype(float)
                    v = (long + inverse @ residual).astype(float)
            except np.linalg.LinAlgError:
                v = np.full(len(at), np.nan)
            V[at] = v
    return V


def stabilizes(
    P: np.ndarray, gamma: float, classes: list[np.ndarray] | None = None
) -> np.ndarray | None:
    """Return w > 0 with w > gamma P w, which proves rho(gamma P) < 1; None if none is found."""
    w = np.ones(len(P))
    for _ in range(2):  # the second round makes w smoother, so that rounding hurts less
        old = w
        w = policy_value(P, old, gamma, classes)
        if not (np.isfinite(w).all() and (w > 0).all()):
            return None
    with np.errstate(all="ignore"):
        slack = w - gamma * (P @ w)
    return w if (slack >= 0.5 * old).all() and (old > 1e-13 * w).all() else None


def policy_iteration(
    arrays: _Arrays, G: np.ndarray, gamma: float, policy: list[int]
) -> tuple[np.ndarray, list[int]]:
    """Improve a gamma-stabilizing policy; change a control only where strictly better."""
    for _ in range(10_000):
        V = policy_value(arrays.P[policy], G[policy], gamma)
        if not (np.isfinite(V).all() and (V >= 0).all()):
            raise ArithmeticError("a policy that should be stabilizing has no finite value")
        Q = G + gamma * (arrays.P @ V)
        better = list(policy)
        for i, choices in enumerate(arrays.choices):
            k = min(choices, key=lambda k: Q[k])
            if Q[k] < Q[policy[i]] * (1 - 1e-13):
                better[i] = k
        if better == policy:
            return V, policy
        policy = better
    raise ArithmeticError("policy iteration does not end")


def tree_policy(arrays: _Arrays) -> list[int]:
    """Breadth-first levels from A: from every cell of C the policy reaches A."""
    chosen: dict[int, int] = {}
    reached: set[int] = set()
    while len(chosen) < arrays.n:
        level: dict[int, int] = {}
        for i, choices in enumerate(arrays.choices):
            if i in chosen:
                continue
            for k in choices:
                row = arrays.model.rows[arrays.pairs[k]]
                if arrays.model.ends or _reaches_in_one(row, reached):
                    level[i] = k
                    break
        chosen |= level
        reached |= {arrays.cells[i] for i in level}
    return [chosen[i] for i in range(arrays.n)]


def nilpotent_policy(arrays: _Arrays) -> list[int] | None:
    """Levels of pairs all of whose successors are in A or lower: exists iff gamma_bar is inf."""
    chosen: dict[int, int] = {}
    done: set[int] = set()
    while len(chosen) < arrays.n:
        level: dict[int, int] = {}
        for i, choices in enumerate(arrays.choices):
            if i in chosen:
                continue
            for k in choices:
                if all(t in done for t in arrays.model.rows[arrays.pairs[k]][0]):
                    level[i] = k
                    break
        if not level:
            return None
        chosen |= level
        done |= {arrays.cells[i] for i in level}
    return [chosen[i] for i in range(arrays.n)]


def largest_gamma(P: np.ndarray, gamma: float) -> float:
    """Bisection for the gamma up to which a policy is stabilizing, from one at which it is."""
    classes = communicating_classes(P)
    low = gamma
    high = 2.0 * low
    while stabilizes(P, high, classes) is not None:
        low, high = high, 2.0 * high
    while high - low > 1e-11 * low:
        middle = 0.5 * (low + high)
        if stabilizes(P, middle, classes) is None:
            high = middle
        else:
            low = middle
    return low


def gamma_bracket(model: ReferenceModel) -> tuple[float, float, list[int], Fraction] | None:
    """Return (low, high, policy, growth): the policy is stabilizing at every gamma <= low (proved).

    No policy is stabilizing where gamma * growth >= 1 (proved, exact); high = 1/growth. None if C
    is empty.
    """
    if model._gamma_bar is None and model.surviving:
        model._gamma_bar = _gamma_bracket(_Arrays(model))
    return model._gamma_bar


def _gamma_bracket(arrays: _Arrays) -> tuple[float, float, list[int], Fraction]:
    policy = nilpotent_policy(arrays)
    if policy is not None:
        return math.inf, math.inf, policy, Fraction(0)
    one = np.ones(arrays.K)
    policy = tree_policy(arrays)
    best = largest_gamma(arrays.P[policy], 1.0)
    while True:  # unit cost just below the reach of a policy prefers every policy that reaches more
        gamma = best * (1 - 1e-9)
        _, other = policy_iteration(arrays, one, gamma, policy)
        reach = largest_gamma(arrays.P[other], gamma)
        if reach <= best * (1 + 1e-10):
            break
        policy, best = other, reach
    low = best
    while not _proved_stabilizing(arrays, policy, low):
        low *= 1 - 1e-9
    growth = Fraction(0)
    for digits in range(2, 10):
        V, _ = policy_iteration(arrays, one, best * (1 - 10.0**-digits), policy)
        growth = max(growth, _unavoidable_growth(arrays, V))
    return low, (float(1 / growth) if growth else math.inf), policy, growth


def _proved_stabilizing(arrays: _Arrays, policy: list[int], gamma: float) -> bool:
    """Check w > gamma P_u w, w > 0, in exact arithmetic."""
    w = stabilizes(arrays.P[policy], gamma)
    if w is None:
        return False
    exact = [Fraction(float(v)) for v in w]
    g = Fraction(gamma)
    return all(exact[i] > 0 and exact[i] > g * arrays.exact(k, exact) for i, k in enumerate(policy))


def _unavoidable_growth(arrays: _Arrays, V: np.ndarray) -> Fraction:
    """Return the largest lam found with P_a w >= lam w for all a: no policy has rho < lam.

    The candidates for w are V on its largest entries and 0 elsewhere.
    """
    best, best_w = 0.0, None
    order = np.argsort(-V)
    for size in range(1, arrays.n + 1):
        w = np.zeros(arrays.n)
        w[order[:size]] = V[order[:size]]
        Pw = arrays.P @ w
        lam = min(Pw[k] / w[i] for i in order[:size] for k in arrays.choices[i])
        if lam > best:
            best, best_w = lam, w
    if best_w is None:
        return Fraction(0)
    exact = [Fraction(float(v)) for v in best_w]
    return min(
        arrays.exact(k, exact) / exact[i]
        for i in range(arrays.n)
        if exact[i] > 0
        for k in arrays.choices[i]
    )


def solve_reference(model: ReferenceModel, gamma: float | None = None) -> ReferenceSolution:
    """Optimal values on C over the gamma-stabilizing policies (over all policies if gamma < 1)."""
    if gamma is None:
        gamma = float(model.problem.get("gamma", 1.0))
    bracket = gamma_bracket(model)
    if bracket is None:
        return ReferenceSolution("not_stabilizable", gamma, None, True)
    low, high, policy, growth = bracket
    bar = (low, high)
    if not model.m:
        return ReferenceSolution("not_stabilizable", gamma, bar, True)
    if Fraction(gamma) * growth >= 1:
        return ReferenceSolution("not_stabilizable", gamma, bar, True)
    if gamma > low:
        return ReferenceSolution("not_stabilizable", gamma, bar, False)

    arrays = _Arrays(model)
    V, policy = policy_iteration(arrays, arrays.G, gamma, policy)
    Q = arrays.G + gamma * (arrays.P @ V)
    ties = [[k for k in c if Q[k] <= V[i] + 1e-9 * V[i]] for i, c in enumerate(arrays.choices)]
    tied_pairs = {arrays.pairs[k] for c in ties for k in c}
    value = {c: float(V[i]) for i, c in enumerate(arrays.cells)}
    C = set(arrays.cells)
    return ReferenceSolution(
        status="ok",
        gamma=gamma,
        gamma_bar=bar,
        decided=True,
        V=value,
        policy={c: arrays.pairs[policy[i]][1] for i, c in enumerate(arrays.cells)},
        ties={c: {arrays.pairs[k][1] for k in ties[i]} for i, c in enumerate(arrays.cells)},
        cost=math.fsum(weight * value[c] for c, weight in model.m.items()),
        policy_reaches=_can_reach(model, [arrays.pairs[k] for k in policy]) == C,
        tied_policy_reaches=surely_reaching(model, tied_pairs)[0] == C,
    )
