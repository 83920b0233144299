"""The cheapest way of a point to the attractor, by trying all controls: what no bound may exceed.

Nothing of lmdsl is used: formulas are Python expressions, cells are found by comparing numbers. As
tests draw starts at random, no state is near enough to an edge for its margin to matter.
"""

from __future__ import annotations

import itertools
import math

NAMES = {**{name: getattr(math, name) for name in ("sin", "cos", "sqrt", "exp", "pi")}, "abs": abs}


class Plain:
    """A problem of small size, as a dictionary says it: what a state becomes, and what it costs."""

    def __init__(self, data):
        self.axes = data["state_box"]
        self.next = data["system"]["next"]
        self.names = [*self.axes]
        grids = [axis["values"] for axis in data["control_grid"].values()]
        self.controls = [
            dict(zip(data["control_grid"], u, strict=True)) for u in itertools.product(*grids)
        ]
        self.cost, self.terminal = data["stage_cost"], data.get("terminal_cost", "0")
        self.factor = data.get("gamma", 1.0) * data.get("discount", 1.0)
        self.targets = {tuple(cell) for cell in data["attractor"].get("cells", [])}
        self.avoid = data.get("avoid", {}).get("boxes", [])
        self.clip = data.get("on_exit") == "clip"
        self.admissible = data.get("admissible", "True")
        self.noise = []
        for name, noise in data.get("noise", {}).items():
            if "uniform" in noise:
                low, high, n = (noise["uniform"][k] for k in ("low", "high", "points"))
                values = [low + (i + 0.5) / n * (high - low) for i in range(n)]
                self.noise.append([(name, x, 1 / n) for x in values])
            else:
                pairs = zip(noise["values"], noise["weights"], strict=True)
                self.noise.append([(name, x, p) for x, p in pairs])

    def nodes(self):
        """Every value of the noise and its probability."""
        for parts in itertools.product(*self.noise):
            yield {name: x for name, x, _ in parts}, math.prod(p for _, _, p in parts)

    def value(self, text, values):
        """The value of an expression."""
        return eval(text, {"__builtins__": {}}, {**NAMES, **values})

    def enter(self, image):
        """The state that an image becomes; None outside the box and in avoid."""
        state = {}
        for name, axis in self.axes.items():
            low, high, x = axis["low"], axis["high"], image[name]
            if axis.get("periodic"):
                x = low + (x - low) % (high - low)
            elif self.clip:
                x = min(max(x, low), high)
            elif not low <= x <= high:
                return None
            state[name] = x
        for box in self.avoid:
            if all(a <= state[name] <= b for name, (a, b) in box.items()):
                return None
        return state

    def entered(self, state):
        """Whether a state lies in the attractor."""
        cell = tuple(
            min(int((state[name] - a["low"]) / (a["high"] - a["low"]) * a["cells"]), a["cells"] - 1)
            for name, a in self.axes.items()
        )
        return cell in self.targets

    def least(self, state, steps):
        """The least cost of laws that surely enter the attractor within so many steps."""
        if steps == 0:
            return math.inf
        found = math.inf
        for u in self.controls:
            if not self.value(self.admissible, {**state, **u}):
                continue
            total = 0.0
            for w, weight in self.nodes():
                values = {**state, **u, **w}
                image = {name: self.value(text, values) for name, text in self.next.items()}
                after = self.enter(image)
                if after is None:
                    total = math.inf
                    break
                if self.entered(after):
                    then = self.value(self.terminal, after)
                else:
                    then = self.least(after, steps - 1)
                total += weight * (self.value(self.cost, values) + self.factor * then)
                if not total < found:
                    break
            found = min(found, total)
        return found
