"""A problem as an environment of Gymnasium, and a controller as a policy that plays it."""

from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from lmdsl.common import inputs
from lmdsl.common.optional import needed
from lmdsl.common.types import Floats, Indices
from lmdsl.control.loop import ClosedLoop
from lmdsl.errors import BadInput, shown
from lmdsl.model.discretization import control_range, control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.results.result import Result

Actions = Literal["discrete", "box"]
RUNNING, REACHED, LOST = "running", "reached", "lost"


def gym_env(
    source: Problem | Result,
    *,
    actions: Actions = "discrete",
    lost: float = 1000.0,
    max_steps: int = 1000,
    as_compiled: bool = False,
) -> Any:
    """Return a problem as an environment of Gymnasium; its runs are those of the true map.

    Parameters
    ----------
    source
        A problem: starts are drawn by its `measure`, off attractor and avoid. A result: they are
        drawn by m on the stabilizable cells.
    actions
        ``discrete``: the index of a control vector. ``box``: any control between the ends of the
        grid.
    lost
        What it costs to lose a run: infinity for the problem, which no learner can use.
    max_steps
        Steps after which a run is truncated.
    as_compiled
        Follow the compiled steps and noise nodes instead.

    Returns
    -------
    gymnasium.Env
        Observations are states. A reward is what a step costs, with minus: stage cost, and gamma
        (and discount) times the terminal cost on entering the attractor; they are to be summed by
        powers of gamma (times the discount), the attribute ``weight``. A run terminates in the
        attractor or lost, see ``info["outcome"]``; ``info["state"]`` is where it is,
        ``info["action_mask"]`` says which actions are admissible there, and an inadmissible one
        loses the run. ``reset(options={"state": x})`` starts where you say.

    Raises
    ------
    BadInput
        There is nowhere to start, an argument is not one of these, or Gymnasium is not installed.
    """
    needed("gymnasium", "gym_env", "gymnasium")
    inputs.kind(source, Problem | Result, "source", "a Problem or a Result")
    if actions not in ("discrete", "box"):
        raise BadInput(f'{shown(actions)} is not accepted; write "discrete" or "box"', "actions")
    if not inputs.is_number(lost) or not 0 <= lost < np.inf:
        raise BadInput(f"{shown(lost)} is no cost; write a finite number >= 0", "lost")
    game = Match(source, actions == "box", inputs.flag(as_compiled, "as_compiled"))
    return _environment()(game, float(lost), inputs.whole(max_steps, "max_steps"))


class Chosen:
    """Takes the place of a controller: gives the control that was chosen."""

    local = None

    def __init__(self, partition: Partition, vectors: Floats) -> None:
        self.partition, self.vectors = partition, vectors
        self.number, self.control = 0, vectors[0]

    def at(self, cell: Indices, x: Floats | None = None) -> Floats:
        """Return the control for every cell, shape (r, p)."""
        return np.tile(self.control, (len(cell), 1))

    @property
    def index(self) -> "Chosen":
        """The index of the control, by cell."""
        return self

    def __getitem__(self, cell: Indices) -> Indices:
        return np.full(np.shape(cell), self.number)


class Match:
    """The runs of a problem under controls that are chosen one by one."""

    def __init__(self, source: Problem | Result, box: bool, as_compiled: bool) -> None:
        problem = source if isinstance(source, Problem) else source.problem
        self.problem, self.box = problem, box
        self.partition = partition = Partition.of(problem)
        self.chosen = Chosen(partition, control_vectors(problem))
        self.status = np.full(partition.size, CellStatus.STABILIZED, dtype=np.uint8)
        if isinstance(source, Result):  # whose attractor may be what holds of the declared one
            kept = np.isin(source.cell_status, (CellStatus.ATTRACTOR, CellStatus.AVOID))
            self.status[kept] = source.cell_status[kept]
            self.start, weight = np.flatnonzero(source.weight), source.weight
        else:
            sets = CellSets.of(problem, partition)
            self.status[sets.attractor] = CellStatus.ATTRACTOR
            self.status[sets.avoid] = CellStatus.AVOID
            self.start, weight = sets.free, sets.mass
        self.start = self.start[weight[self.start] > 0]
        if not len(self.start):
            raise BadInput("there is no cell to start from: no free cell carries weight", "measure")
        self.until = np.cumsum(weight[self.start] / weight[self.start].max())
        self.loop = ClosedLoop(problem, self.chosen, self.status, as_compiled)  # type: ignore[arg-type]
        if box and self.loop.draws is not None:
            raise BadInput("a finite model has no controls between those given", "actions")
        self.admitted = problem.admitted()

    def draw(self, rng: np.random.Generator) -> Floats:
        """Return a random start, shape (1, d): a cell by its weight, then uniform inside."""
        k = np.searchsorted(self.until, rng.random() * self.until[-1], side="right")
        cell = self.start[[min(int(k), len(self.start) - 1)]]
        if self.loop.draws is not None:
            return self.partition.centres(cell)
        index = np.stack(self.partition.multi_index(cell), axis=-1)
        within = rng.random(index.shape)
        return self.partition.low + (index + within) * self.partition.width

    def choose(self, action: Any) -> None:
        """Set the control of the next step."""
        if self.box:
            self.chosen.control = np.asarray(action, dtype=np.float64).reshape(-1)
            return
        self.chosen.number = inputs.whole(action, "action", 0, len(self.chosen.vectors) - 1)
        self.chosen.control = self.chosen.vectors[self.chosen.number]

    def admissible(self, x: Floats, controls: Floats) -> Any:
        """Return which controls (r, p) are admissible in a state (1, d), shape (r,)."""
        if self.admitted is None:
            return np.ones(len(controls), dtype=np.bool_)
        x = np.repeat(x, len(controls), axis=0)
        (found,) = self.admitted(dict(zip((*self.problem.states, *self.problem.controls),
                                          (*x.T, *controls.T), strict=True)))  # fmt: skip
        return np.broadcast_to(found != 0, len(controls))

    def outcome(self, cell: Indices) -> str:
        """Return what a run in a cell is."""
        status = self.status[cell[0]] if cell[0] >= 0 else CellStatus.AVOID
        if status == CellStatus.ATTRACTOR:
            return REACHED
        return RUNNING if status == CellStatus.STABILIZED else LOST


class Played:
    """A problem that is played: what an environment of Gymnasium is to do."""

    np_random: np.random.Generator  # Gymnasium's

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, game: Match, lost: float, max_steps: int) -> None:
        from gymnasium import spaces

        self.game, self.lost, self.max_steps = game, lost, max_steps
        self.weight = game.loop.weight
        low, high = game.partition.low, game.partition.high
        self.observation_space = spaces.Box(low, high, dtype=np.float64)
        if game.box:
            least, most = control_range(game.problem)
            self.action_space: Any = spaces.Box(least, most, dtype=np.float64)
        else:
            self.action_space = spaces.Discrete(len(game.chosen.vectors))
        self.x = np.full((1, game.partition.dimension), np.nan)
        self.cell, self.outcome, self.taken = np.array([-1]), LOST, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        """Start a run; see :func:`gym_env` for the options."""
        super().reset(seed=seed)  # type: ignore[misc]  # of gymnasium.Env
        game = self.game
        if options and "state" in options:
            x = inputs.states(options["state"], game.partition.names, "state").reshape(1, -1)
        else:
            x = game.draw(self.np_random)
        self.x, self.cell = game.partition.enter(x)
        self.outcome, self.taken = game.outcome(self.cell), 0
        if self.outcome == LOST:
            raise BadInput(f"{x[0].tolist()} is off the box, or in avoid", "state")
        return self._observation(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Any]:
        """Make a step; return observation, reward, terminated, truncated, info."""
        if self.outcome == LOST or (self.outcome == REACHED and self.taken):
            raise BadInput("the run has ended; call reset() to start another")
        game = self.game
        game.choose(action)
        self.taken += 1
        cost = self.lost
        if game.admissible(self.x, game.chosen.control[None, :])[0]:
            moved = game.loop.move(self.x, self.cell, self.np_random)
            self.x, self.cell = moved.state, moved.cell
            self.outcome = game.outcome(self.cell)
            cost = float(moved.cost[0])
            if self.outcome == REACHED:
                cost += self.weight * float(game.loop.paid(self.x)[0])
            if self.outcome == LOST:
                cost = self.lost
        else:
            self.outcome = LOST
        ended = self.outcome != RUNNING
        cut = not ended and self.taken >= self.max_steps
        return self._observation(), -cost, ended, cut, self._info()

    def _observation(self) -> Any:
        """Return the state, moved into the box where a run is lost outside."""
        space = self.observation_space
        inside = np.clip(self.x[0], space.low, space.high)
        return np.where(np.isfinite(inside), inside, space.low)

    def _info(self) -> dict[str, Any]:
        info = {"state": self.x[0].copy(), "cell": int(self.cell[0]), "outcome": self.outcome}
        if not self.game.box:
            mask = self.game.admissible(self.x, self.game.chosen.vectors)
            info["action_mask"] = mask.astype(np.int8)
        return info


@cache
def _environment() -> Any:
    """Return the class of environments; Gymnasium is imported by now."""
    import gymnasium

    return type("StabilizationEnv", (Played, gymnasium.Env), {"__doc__": "A problem, played."})


def policy(
    result: Result, *, actions: Actions = "discrete", otherwise: int | None = None
) -> "Player":
    """Return the controller of a result as a policy: from observations to actions.

    Parameters
    ----------
    result
        An answer with a controller.
    actions
        As of :func:`gym_env`.
    otherwise
        The index of the control vector where the controller says nothing; by default this is
        refused.

    Returns
    -------
    Player
        Called with an observation (d,), or several (r, d), it returns one action or r of them.
    """
    inputs.kind(result, Result, "result", "a Result")
    if actions not in ("discrete", "box"):
        raise BadInput(f'{shown(actions)} is not accepted; write "discrete" or "box"', "actions")
    if (result.control_index < 0).all():
        raise BadInput("there is no controller to play: " + result.message)
    if otherwise is not None:
        otherwise = inputs.whole(otherwise, "otherwise", 0, len(result.control_vectors) - 1)
    return Player(result, actions == "box", otherwise)


class Player:
    """A controller as a policy; see :func:`policy`."""

    def __init__(self, result: Result, box: bool, otherwise: int | None) -> None:
        self.controller, self.box, self.otherwise = result.controller, box, otherwise

    def __call__(self, observation: ArrayLike) -> Any:
        """Return the action for an observation (d,), or for several (r, d)."""
        partition = self.controller.partition
        given = inputs.states(observation, partition.names, "observation")
        states, cell = partition.enter(given.reshape(-1, partition.dimension))
        index = np.where(cell >= 0, self.controller.index[cell], -1).astype(np.int64)
        found = self.controller.at(cell, states) if self.box else index
        none = np.isnan(found).any(axis=-1) if self.box else found < 0
        if none.any():
            if self.otherwise is None:
                raise BadInput(
                    f"the controller says nothing at {states[none][0].tolist()}; start on the "
                    "stabilizable cells, gym_env(result), or say what else to do by `otherwise`",
                    "observation",
                )
            other = self.controller.vectors[self.otherwise] if self.box else self.otherwise
            found = found.copy()
            found[none] = other
        if given.ndim == 1:
            return found[0] if self.box else int(found[0])
        return found.reshape(*given.shape[:-1], *found.shape[1:])
