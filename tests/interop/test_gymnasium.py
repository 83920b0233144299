"""Gymnasium both ways: its own checker, runs beside the closed loop, its own environments."""

import warnings

import numpy as np
import pytest
from pages import ROOT, blocks
from problems import doubling, made, standard_map, steps

import lmdsl as lm

gymnasium = pytest.importorskip("gymnasium")
checker = pytest.importorskip("gymnasium.utils.env_checker")

TABLE = {
    "P": [[[0, 0.5, 0.5], [0, 0, 1], [0, 0, 1]], [[0, 0, 1.0], [0.25, 0.75, 0], [0, 0, 1]]],
    "cost": [[1.0, 3.0], [2.0, 1.0], [0.0, 0.0]],
    "targets": [2],
}
PENDULUM = {
    **lm.systems.NAMED["inverted_pendulum"].problem,
    "terminal_cost": "1",
}
SOURCES = {
    "map": lambda: made(steps()),
    "autonomous": lambda: made(doubling()),
    "circle": lambda: made(standard_map(10)),
    "noise": lambda: made(
        standard_map(8, system={"kind": "map", "next": {"x": "x + y + u", "y": "y + w"}},
                     noise={"w": {"normal": {"std": 0.05, "points": 3}}})
    ),
    "admissible": lambda: made(standard_map(10, admissible="abs(u) < 0.3")),
    "equation": lambda: made(PENDULUM),
    "finite": lambda: lm.from_matrices(**TABLE),
    "recorded": lambda: lm.solve(made(standard_map(10))),
}  # fmt: skip


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("actions", ["discrete", "box"])
def test_gymnasium_finds_nothing(name, actions):
    if actions == "box" and name in ("finite", "autonomous"):
        pytest.skip("no controls between those of the grid")
    env = lm.interop.gym_env(SOURCES[name](), actions=actions, max_steps=50)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*render_mode.*")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        warnings.filterwarnings("ignore", message=".*`spec` is None.*|.*not tested.*")
        checker.check_env(env, skip_render_check=True)


def test_a_policy_plays_what_the_closed_loop_does():
    """From the same starts the same states, and costs that sum to the certificate's bound."""
    result = lm.solve(made(standard_map(20)))
    env, play = lm.interop.gym_env(result), lm.interop.policy(result)
    for seed in range(20):
        x, info = env.reset(seed=seed)
        wanted = result.closed_loop.path(x, 500)
        states, ended = [x], False
        while not ended:
            x, _, ended, _, info = env.step(play(x))
            states.append(x)
        np.testing.assert_array_equal(states, wanted)
        assert info["outcome"] == "reached"


def test_returns_of_deterministic_steps_are_the_certified_costs():
    """x+ = x - 0.25 u, cost 1, gamma 1.02 and a terminal cost: V is met by every run."""
    result = lm.solve(made(steps(1.02, terminal_cost="0.5")))
    env, play = lm.interop.gym_env(result), lm.interop.policy(result)
    for seed in range(10):
        x, info = env.reset(seed=seed)
        cell, total, power, ended = info["cell"], 0.0, 1.0, False
        while not ended:
            x, reward, ended, _, _ = env.step(play(x))
            total, power = total - power * reward, power * env.weight
        assert total == pytest.approx(result.value[cell], rel=1e-12)


def test_many_are_played_at_a_time():
    """Gymnasium's vectors of environments; and copies, as other processes get them."""
    cloudpickle = pytest.importorskip("cloudpickle")
    result = lm.solve(made(standard_map(20)))
    env, play = lm.interop.gym_env(result), lm.interop.policy(result)
    copy = cloudpickle.loads(cloudpickle.dumps(env))
    for each in (env, copy):
        each.reset(seed=5)
    for _ in range(3):
        (x, *one), (y, *other) = env.step(3), copy.step(3)
        np.testing.assert_array_equal(x, y)
        assert one[:3] == other[:3]
        if one[1]:
            break
    many = gymnasium.vector.SyncVectorEnv([lambda: lm.interop.gym_env(result)] * 3)
    x, _ = many.reset(seed=[0, 1, 2])
    actions = play(x)
    assert actions.shape == (3,)
    x, reward, *_ = many.step(actions)
    for seed in range(3):
        start, _ = env.reset(seed=seed)
        alone, paid, *_ = env.step(play(start))
        np.testing.assert_array_equal(x[seed], alone)
        assert reward[seed] == paid


def test_what_holds_of_an_attractor_is_the_goal():
    """Of a result that holds, runs end on the cells that hold, not on all declared ones."""
    data = steps(
        attractor={"cells": [[0], [2]]}, local_controller={"kind": "hold"},
        system={"kind": "map", "next": {"x": "where(x < 0.25, x, x - 0.25)"}},
        control_grid={},
    )  # fmt: skip
    result = lm.solve(made(data))
    assert result.cell_status.tolist() == [0, 1, 1, 1]
    env = lm.interop.gym_env(result)
    env.reset(options={"state": [0.9]})
    outcomes = [env.step(0)[4]["outcome"] for _ in range(3)]
    assert outcomes == ["running", "running", "reached"]
    declared = lm.interop.gym_env(made(data))
    declared.reset(options={"state": [0.9]})
    assert declared.step(0)[4]["outcome"] == "reached"


def test_finite_models_are_played_by_their_rows():
    problem = lm.from_matrices(**TABLE)
    env = lm.interop.gym_env(problem)
    counts = np.zeros(3)
    for seed in range(400):
        env.reset(seed=seed, options={"state": [0.0]})
        _, reward, *_, info = env.step(0)
        counts[info["cell"]] += 1
        assert reward == -1.0
    assert counts[0] == 0
    assert abs(counts[1] - 200) < 60


def test_lost_runs_end_and_cost_what_is_said():
    env = lm.interop.gym_env(made(steps()), lost=7.0)
    env.reset(options={"state": [0.9]})
    leaving = made(steps(system={"kind": "map", "next": {"x": "x - 0.25*u + 5*(1 - u)"}}))
    env = lm.interop.gym_env(leaving, lost=7.0)
    env.reset(options={"state": {"x": 0.9}})
    x, reward, ended, cut, info = env.step(0)
    assert (reward, ended, cut, info["outcome"]) == (-7.0, True, False, "lost")
    assert env.observation_space.contains(x)
    assert info["state"][0] == pytest.approx(5.9)
    with pytest.raises(lm.BadInput, match=r"reset\(\)"):
        env.step(0)


def test_inadmissible_actions_lose_the_run():
    env = lm.interop.gym_env(made(standard_map(10, admissible="abs(u) < 0.3")))
    _, info = env.reset(seed=0)
    u = env.game.chosen.vectors[:, 0]
    np.testing.assert_array_equal(info["action_mask"], np.abs(u) < 0.3)
    *_, ended, _, info = env.step(0)
    assert ended
    assert info["outcome"] == "lost"


def test_the_policy_says_where_it_says_nothing():
    result = lm.solve(made(steps()))
    play = lm.interop.policy(result)
    with pytest.raises(lm.BadInput, match="observation: the controller says nothing at"):
        play([0.1])  # the attractor
    assert lm.interop.policy(result, otherwise=1)([0.1]) == 1
    assert play([[0.3], [0.6]]).tolist() == [1, 1]
    box = lm.interop.policy(result, actions="box")
    np.testing.assert_array_equal(box([[0.3], [0.6]]), [[1.0], [1.0]])
    with pytest.raises(lm.BadInput, match="no controller to play"):
        lm.interop.policy(lm.solve(made(standard_map(8, system={
            "kind": "map", "next": {"x": "x", "y": "y"}}))))  # fmt: skip


# The other way round --------------------------------------------------------------------------


def test_the_environments_own_steps_are_the_system():
    """Their equations by hand, and the steps of their own environments."""
    env = gymnasium.make("Pendulum-v1")
    system = lm.interop.from_gym(env, ["theta", "omega"], "torque")
    rng = np.random.default_rng(0)
    for th, om, u in rng.uniform([-3, -8, -2.5], [3, 8, 2.5], (50, 3)):
        held = np.clip(np.float32(u), -2, 2)
        omega = np.clip(om + (15 * np.sin(th) + 3 * held) * 0.05, -8, 8)
        found = system.next(theta=th, omega=om, torque=u)
        assert found["omega"] == pytest.approx(omega, rel=1e-6)
        assert found["theta"] == pytest.approx(th + omega * 0.05, rel=1e-6)


def test_the_pendulum_swings_up_in_their_own_environment():
    env = gymnasium.make("Pendulum-v1")
    around = {"low": -np.pi, "high": np.pi, "cells": 24, "periodic": True}
    problem = lm.Problem(
        system=lm.interop.from_gym(env, ["theta", "omega"], "torque", repeat=2),
        state_box={"theta": around, "omega": {"low": -8, "high": 8, "cells": 24}},
        attractor={"boxes": [{"theta": [-np.pi / 12, np.pi / 12], "omega": [-4 / 3, 4 / 3]}]},
        control_grid={"torque": {"low": -2, "high": 2, "points": 3}},
        stage_cost="1",
        sampling={"kind": "grid", "per_axis": 2},
        on_exit="clip",
    )
    result, own = lm.solve(problem), gymnasium.make("Pendulum-v1")
    assert result.status == "verified"
    for seed in range(10):
        own.reset(seed=seed)
        for _ in range(100):
            u = result.controller(own.unwrapped.state)
            if np.isnan(u).any():
                break
            own.step(u)
            own.step(u)
        theta, omega = own.unwrapped.state
        assert np.cos(theta) >= np.cos(np.pi / 12) - 1e-9
        assert abs(omega) <= 4 / 3 + 1e-9


def test_the_car_on_the_mountain():
    env = gymnasium.make("MountainCar-v0")
    system = lm.interop.from_gym(env, ["position", "velocity"], "push")
    own = gymnasium.make("MountainCar-v0").unwrapped
    own.reset(seed=1)
    for k in range(60):
        before = own.state
        own.step(k // 20)
        found = system.next(position=before[0], velocity=before[1], push=float(k // 20))
        assert (found["position"], found["velocity"]) == tuple(map(float, own.state))
    twice = lm.interop.from_gym(env, ["position", "velocity"], "push", repeat=2)
    once = system.next(position=-0.3, velocity=0.01, push=2.0)
    assert twice.next(position=-0.3, velocity=0.01, push=2.0) == system.next(**once, push=2.0)


def cart_pole(cells, repeat):
    """Safety, as a run that ends with probability 0.01 a step and no other way."""
    ends = dict(zip(("x", "v", "theta", "omega"), (2.4, 3, 0.2094, 3), strict=True))
    env = gymnasium.make("CartPole-v1")
    return lm.Problem(
        system=lm.interop.from_gym(env, [*ends], "push", repeat=repeat),
        state_box={name: {"low": -a, "high": a, "cells": n}
                   for (name, a), n in zip(ends.items(), cells, strict=True)},
        attractor={},
        discount=0.99,
        control_grid={"push": {"values": [0, 1]}},
        stage_cost="(x/2.4)**2 + (theta/0.2)**2",
        sampling={"kind": "grid", "per_axis": 1},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("cells", "repeat", "least"),
    [((5, 9, 9, 11), 2, 150), pytest.param((6, 12, 12, 16), 3, 500, marks=pytest.mark.long)],
)
def test_the_cart_pole_is_balanced_in_gymnasiums_own(cells, repeat, least):
    """500 steps are all that Gymnasium asks for; without control it falls after about 10."""
    result, own = lm.solve(cart_pole(cells, repeat)), gymnasium.make("CartPole-v1")
    assert result.status == "verified"
    for seed in range(5):
        own.reset(seed=seed)
        steps, ended, cut = 0, False, False
        while not (ended or cut):
            (u,) = result.controller(own.unwrapped.state)
            for _ in range(repeat):
                _, _, ended, cut, _ = own.step(int(u))
                steps += 1
                if ended or cut:
                    break
        assert steps >= least


def test_the_cart_pole_can_fall_again_and_again():
    system = lm.interop.from_gym(
        gymnasium.make("CartPole-v1"), ["x", "v", "theta", "omega"], "push"
    )
    fallen = {"x": 0.0, "v": 0.0, "theta": 1.0, "omega": 0.0}
    first = system.next(**fallen, push=1.0)
    assert [system.next(**fallen, push=1.0) for _ in range(3)] == [first] * 3
    assert first["theta"] == 1.0
    assert first["omega"] > 0


def test_the_example_of_the_readme_runs():
    text = (ROOT / "README.md").read_text()
    (block,) = [b for b in blocks(text) if b.language == "python" and "from_gym" in b.text]
    assert sum(bool(line.strip()) for line in block.text.splitlines()) <= 15
    space = {}
    exec(block.text, space)
    result, env = space["result"], gymnasium.make("MountainCar-v0")
    assert result.status == "verified"
    for seed in range(20):
        env.reset(seed=seed)
        for _ in range(200):
            u = result.controller(env.unwrapped.state)
            _, _, ended, cut, _ = env.step(int(u[0]))
            if ended or cut:
                break
        assert ended, seed  # within the 200 steps of Gymnasium's own limit


def test_what_is_no_such_environment_is_refused():
    make = gymnasium.make
    for arguments, where in (
        ((7, "x"), "env: 7 is no environment"),
        ((make("CartPole-v1"), ["x", "v"], "push"), "states: .* 2 parts x, v; it has 4"),
        ((make("FrozenLake-v1"), "x", "u"), "states: .* it has 0"),
        ((make("Pendulum-v1"), ["x", "v"], ["u", "v"]), "controls: an action has 1 parts"),
    ):
        with pytest.raises(lm.BadInput, match=where):
            lm.interop.from_gym(*arguments)
    system = lm.interop.from_gym(make("MountainCar-v0"), ["x", "v"], "push")
    for u in (0.5, 3.0, -1.0):
        with pytest.raises(lm.BadInput, match="whole numbers from 0 to 2"):
            system.next(x=0.0, v=0.0, push=u)
