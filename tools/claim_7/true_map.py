"""The map and its paths, on boxes."""

from claim_7 import jets
from claim_7.formulas import Formulas
from claim_7.jets import constant


class TrueMap:
    """The map, on boxes."""

    def __init__(self, said):
        self.names = [*said["states"], *said["controls"], *said["noise"]]
        parameters = {name: float.fromhex(x) for name, x in said["parameters"].items()}
        formulas = Formulas(self.names, parameters, said["let"])
        self.formulas, self.places = formulas, [formulas.read(text) for text in said["formulas"]]
        self.admissible = None
        if said["admissible"] is not None:
            self.admissible = formulas.read(said["admissible"], condition=True)
        self.dimension = len(said["states"])
        self.ode = said["ode"] is not None
        self.path = self.ode and said["ode"][2]
        if self.ode:
            self.h, self.substeps = float.fromhex(said["ode"][0]), said["ode"][1]
            if not 1 <= self.substeps <= 1000:
                raise ValueError("the number of substeps is none")
        if len(self.places) != self.dimension or not self.dimension:
            raise ValueError("the states have other formulas")

    def _field(self, state, held):
        return self.formulas.values(
            self.places, dict(zip(self.names, (*state, *held), strict=True))
        )

    def step(self, values):
        """Return the images, and the arcs of the path: of each start, slopes and the way."""
        state, held, arcs = values[: self.dimension], values[self.dimension :], []
        if not self.ode:
            return self._field(state, held), arcs
        for _ in range(self.substeps):
            k1 = self._field(state, held)
            k2 = self._field(moved(state, self.h / 2, k1), held)
            k3 = self._field(moved(state, self.h / 2, k2), held)
            k4 = self._field(moved(state, self.h, k3), held)
            sums = []
            for a, b, c, d in zip(k1, k2, k3, k4, strict=True):
                middle = jets.add(jets.add(a, scaled(2.0, b)), scaled(2.0, c))
                sums.append(jets.add(middle, d))
            arcs.append([state, k1, None, [scaled(self.h / 6, s) for s in sums]])
            state = moved(state, self.h / 6, sums)
        if self.path:
            slopes = [*(arc[1] for arc in arcs), self._field(state, held)]
            for k, arc in enumerate(arcs):
                arc[1:3] = ([scaled(self.h, y) for y in slope] for slope in slopes[k : k + 2])
        return state, arcs

    def admits(self, values):
        """Return whether the condition of admissible pairs holds on the whole box."""
        if self.admissible is None:
            return True
        given = dict(zip(self.names, values, strict=True))
        return self.formulas.values([self.admissible], given)[0] is True


def scaled(c, x):
    """Return c x."""
    return jets.multiply(constant(c), x)


def moved(state, c, slopes):
    """Return state + c slopes."""
    return [jets.add(x, scaled(c, k)) for x, k in zip(state, slopes, strict=True)]


def bernstein(s, e):
    """Return the Bernstein points of a cubic Hermite arc from s to e: multiples of (m, n, r).

    Those of the whole arc are 0, m/3, r - n/3 and r beside its start, for slopes m, n and way r;
    those of a part are its blossom.
    """
    for u, v, w in ((s, s, s), (s, s, e), (s, e, e), (e, e, e)):
        one = u * (1 - v) * (1 - w) + v * (1 - u) * (1 - w) + w * (1 - u) * (1 - v)
        two = u * v * (1 - w) + u * w * (1 - v) + v * w * (1 - u)
        yield one / 3, -two / 3, two + u * v * w


def combined(factors, terms):
    """Return a sum of multiples of jets."""
    total = constant(0.0)
    for factor, term in zip(factors, terms, strict=True):
        if factor:
            total = jets.add(total, scaled(factor, term))
    return total
