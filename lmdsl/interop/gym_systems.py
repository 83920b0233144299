"""A Gymnasium environment whose state can be set, as a system."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.optional import needed
from lmdsl.errors import BadInput, shown
from lmdsl.systems.function import FunctionSystem


def from_gym(
    env: Any,
    states: Sequence[str],
    controls: Sequence[str] = (),
    repeat: int = 1,
    attribute: str = "state",
) -> FunctionSystem:
    """Return a Gymnasium environment as a system: steps of it are a step of the system.

    Parameters
    ----------
    env
        The environment; its wrappers, a time limit say, are left aside. It must be deterministic,
        and is used from now on: make one for this.
    states
        Names of the parts of its state, in order.
    controls
        Names of the parts of an action, in order: one for a discrete action, whose values are
        those of the action space.
    repeat
        Steps of the environment, under one action, that are a step of the system: so many that
        states move on by a cell or more.
    attribute
        The attribute of the environment that holds the state and can be set.

    Returns
    -------
    FunctionSystem
        To be called one sample at a time. Observations, rewards and ends are not used: what is to
        be reached and what it costs is for the problem to say.

    Raises
    ------
    BadInput
        It is no environment, holds no such state, or its action has other parts.
    """
    gymnasium = needed("gymnasium", "from_gym", "gymnasium")
    if not isinstance(env, gymnasium.Env):
        raise BadInput(f"{shown(env)} is no environment of Gymnasium", "env")
    names = (states,) if isinstance(states, str) else tuple(states)
    actions = (controls,) if isinstance(controls, str) else tuple(controls)
    own = env.unwrapped
    own.reset(seed=0)
    held = np.size(getattr(own, attribute)) if hasattr(own, attribute) else 0
    if held != len(names):
        raise BadInput(
            f"the environment's `{attribute}` is to have the {len(names)} parts "
            f"{', '.join(names)}; it has {held}",
            "states",
        )
    space = own.action_space
    discrete = isinstance(space, gymnasium.spaces.Discrete)
    if not discrete and not isinstance(space, gymnasium.spaces.Box):
        raise BadInput(f"actions of {shown(space)} are not supported, only Discrete and Box", "env")
    count = 1 if discrete else int(np.prod(space.shape))
    if len(actions) != count:
        given = ", ".join(actions) or "none"
        raise BadInput(f"an action has {count} parts, the names are {given}", "controls")
    times = inputs.whole(repeat, "repeat")
    step = GymStep(own, names, actions, attribute, times)
    return FunctionSystem(next=step, vectorized=False)


class GymStep:
    """Steps of an environment from a state that is set, under one action."""

    def __init__(
        self, env: Any, states: tuple[str, ...], controls: tuple[str, ...], attribute: str,
        repeat: int,
    ) -> None:  # fmt: skip
        self.env, self.states, self.controls = env, states, controls
        self.attribute, self.repeat = attribute, repeat
        held = getattr(env, attribute)
        self.shape = np.shape(held)
        self.as_array = isinstance(held, np.ndarray)

    def __call__(self, **values: float) -> dict[str, float]:
        """Return the state after the steps."""
        start = np.array([values[name] for name in self.states])
        setattr(self.env, self.attribute, start.reshape(self.shape) if self.as_array
                else tuple(start.tolist()))  # fmt: skip
        action = self._action(values)
        for _ in range(self.repeat):
            if hasattr(self.env, "steps_beyond_terminated"):  # the cart-pole counts, and complains
                self.env.steps_beyond_terminated = None
            self.env.step(action)
        after = np.ravel(getattr(self.env, self.attribute))
        return dict(zip(self.states, map(float, after), strict=True))

    def _action(self, values: dict[str, float]) -> Any:
        space, u = self.env.action_space, [values[name] for name in self.controls]
        if not hasattr(space, "n"):
            return np.array(u, dtype=space.dtype).reshape(space.shape)
        action = int(u[0])
        if action != u[0] or not space.contains(action):
            first = int(space.start)
            raise BadInput(
                f"{u[0]!r} is no action; the values of {self.controls[0]} are whole numbers from "
                f"{first} to {first + int(space.n) - 1}",
                f"control_grid.{self.controls[0]}",
            )
        return action
