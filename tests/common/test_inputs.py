"""Odd arguments of public functions: the right answer, or one clear sentence."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.systems import NAMED

BIG = 99999999999999999999
NO_COUNTS = [BIG * 10**400, -1, 0, 2.0, True, "3", np.float64(3), np.nan, [1]]
RESULT = lm.solve(made(steps()))
PLANE = lm.solve(made(standard_map(10)))
LOST = lm.explain(made(steps(avoid={"boxes": [{"x": [0.5, 0.75]}]})))


def refused(call, *words):
    with pytest.raises(lm.BadInput) as error:
        call()
    text = str(error.value)
    assert text.isprintable()
    assert len(text) < 400
    for word in words:
        assert word in text
    return text


# Counts --------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", NO_COUNTS, ids=lambda x: ascii(x)[:12])
@pytest.mark.parametrize("name", ["starts", "steps", "hold"])
def test_counts_are_whole_numbers(bad, name):
    if bad == 0 and bad is not True:
        refused(lambda: RESULT.simulate(**{name: bad}), name)
        return
    if name == "starts" and bad == [1]:  # that is a state to start from
        return
    refused(lambda: RESULT.simulate(**{"starts": 5, name: bad}), name)


@pytest.mark.parametrize("bad", [BIG, -1, 0.0, True, "3", np.nan, [1]], ids=ascii)
def test_seeds_are_whole_numbers(bad):
    refused(lambda: RESULT.simulate(starts=5, seed=bad), "seed")
    refused(lambda: RESULT.closed_loop.path([0.9], 3, bad), "seed")
    refused(lambda: lm.plotting.trajectories(PLANE, seed=bad), "seed")
    refused(lambda: lm.plotting.figure(PLANE, seed=bad), "seed")


@pytest.mark.parametrize("spec", ["policy-iteration", "highs", "clarabel", "cvxpy", "cvxpy:scs"])
def test_a_huge_iteration_limit_is_none(spec):
    for most in (BIG, 10**400, np.int64(2**62)):
        assert lm.solve(RESULT.lp, spec, max_iterations=most).status == "verified"


def test_limits_that_are_no_numbers_or_too_large():
    for bad in (10**400, np.inf, np.nan, -1, True, "3", None, [1]):
        refused(lambda bad=bad: lm.solve(RESULT.lp, tolerance=bad), "tolerance")
    for bad in (np.nan, -1, 0, True, "3", [1]):
        refused(lambda bad=bad: lm.solve(RESULT.lp, time_limit=bad), "time_limit")
    for long in (10**400, np.inf, 1e300, np.float32(7)):
        assert lm.solve(RESULT.lp, time_limit=long).status == "verified"
    for bad in (BIG * 10**400, 0, 1.5, True):
        refused(lambda bad=bad: lm.explain(made(steps()), regions=bad), "regions")
        refused(lambda bad=bad: lm.plotting.portrait(PLANE, steps=bad), "steps")
        refused(lambda bad=bad: lm.plotting.trajectories(PLANE, starts=bad), "starts")


def test_runs_that_do_not_fit_in_memory_are_refused_before_they_start():
    for call in (
        lambda: RESULT.simulate(starts=10**14),
        lambda: lm.plotting.trajectories(PLANE, starts=10**14),
        lambda: lm.plotting.portrait(PLANE, steps=10**14),
    ):
        refused(call, "memory", "runs")


@pytest.mark.parametrize("option", ["--starts", "--steps", "--seed", "--hold"])
def test_huge_integers_on_the_command_line(option, tmp_path, capsys):
    RESULT.save(tmp_path / "out")
    assert main(["simulate", str(tmp_path / "out"), option, str(BIG)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    made(steps()).save(tmp_path / "p.json")
    assert main(["solve", str(tmp_path / "p.json"), "--max-iterations", str(BIG)]) == 0


# States --------------------------------------------------------------------------------------


class Table:
    """As pandas has it, in the parts that matter."""

    def __init__(self, columns):
        self.data, self.columns = columns, list(columns)

    def __getitem__(self, name):
        return self.data[name]

    def to_numpy(self):
        return np.stack(list(self.data.values()), axis=-1)

    def __array__(self, dtype=None, copy=None):
        return self.to_numpy()


class Row:
    """A labelled row of such a table."""

    def __init__(self, data):
        self.data, self.index = data, list(data)

    def __getitem__(self, name):
        return self.data[name]

    def to_numpy(self):
        return np.array(list(self.data.values()))

    __array__ = lambda self, dtype=None, copy=None: self.to_numpy()  # noqa: E731


def test_states_are_taken_by_name_where_they_have_names():
    rng = np.random.default_rng(0)
    x, y = rng.random(50), rng.random(50)
    control = PLANE.controller
    expected = control(np.stack([x, y], axis=-1))
    assert not np.array_equal(expected, control(np.stack([y, x], axis=-1)), equal_nan=True)
    record = np.zeros(50, dtype=[("y", float), ("x", float)])
    record["x"], record["y"] = x, y
    for given in (
        {"x": x, "y": y}, {"y": y, "x": x}, {"y": y, "t": x * 0, "x": x.tolist()}, record,
        Table({"x": x, "y": y}), Table({"y": y, "x": x}), Table({"t": x, "y": y, "x": x}),
        Table({0: x, 1: y}), np.asfortranarray(np.stack([x, y], axis=-1)),
    ):  # fmt: skip
        np.testing.assert_array_equal(control(given), expected)
    for row in (Row({"y": y[0], "x": x[0]}), Row({0: x[0], 1: y[0]}), {"x": x[0], "y": y[0]}):
        np.testing.assert_array_equal(control(row), expected[0])
    np.testing.assert_array_equal(control({"x": 0.3, "y": y}), control([[0.3, v] for v in y]))


def test_a_table_of_pandas():
    pandas = pytest.importorskip("pandas")
    x, y = np.random.default_rng(0).random((2, 20))
    expected = PLANE.controller(np.stack([x, y], axis=-1))
    for frame in (
        pandas.DataFrame({"y": y, "x": x}),
        pandas.DataFrame({"t": x, "y": y, "x": x}),
        pandas.DataFrame(np.stack([x, y], axis=-1)),
    ):
        np.testing.assert_array_equal(PLANE.controller(frame), expected)
    refused(lambda: PLANE.controller(pandas.DataFrame({"p": x, "q": y})), "the columns are 'p'")


@pytest.mark.parametrize(
    "columns", [("a", "b"), ("x",), ("x", "z"), ("X", "Y"), (1, 2), (), ("x", 1)]
)
def test_names_that_are_not_the_axes_are_refused(columns):
    data = {name: np.zeros(3) for name in columns}
    for given in (Table(data), data):
        text = refused(lambda given=given: PLANE.controller(given), "columns", "x, y")
        assert "one column" in text


@pytest.mark.parametrize("x", [
    "ab", ["a", "b"], [0.1, None], [0.1, 1j], [True, False], [[0.1], [0.1, 0.2]], None, object(), 7,
    [0.1, 0.2, 0.3], np.zeros((2, 3)), np.array(["0.1", "0.2"]), np.array([1, 2], "datetime64[s]"),
    np.ma.MaskedArray([0.1, 0.2], [True, False]), [10**400, 0],
    {"x": np.zeros(2), "y": np.zeros(3)},
], ids=lambda x: f"{type(x).__name__} {ascii(x)[:14]}")  # fmt: skip
def test_what_is_no_state_is_refused(x):
    refused(lambda: PLANE.controller(x))
    refused(lambda: PLANE.closed_loop.path(x, 3))


def test_states_of_any_real_kind():
    from fractions import Fraction

    expected = PLANE.controller([0.25, 0.75])
    for x in (
        np.array([0.25, 0.75], np.float16), [Fraction(1, 4).__float__(), 0.75],
        np.array([0.25, 0.75], dtype=object), (0.25, 0.75), np.longdouble([0.25, 0.75]),
    ):  # fmt: skip
        np.testing.assert_array_equal(PLANE.controller(x), expected)
    assert PLANE.controller(np.zeros((0, 2))).shape == (0, 1)
    assert PLANE.controller(np.zeros((2, 3, 2))).shape == (2, 3, 1)


def test_paths_from_odd_starts():
    loop = RESULT.closed_loop
    assert loop.path([7.3], 5).tolist() == [[7.3]]  # lost before the first step
    assert loop.path({"x": 0.9}, 0).tolist() == [[0.9]]
    np.testing.assert_array_equal(loop.path(np.array([[0.9]]), 9), loop.path([0.9], 9))
    for x in ([np.nan], [np.inf], [0.1, 0.2], [[0.1], [0.2]]):
        refused(lambda x=x: loop.path(x, 3))
    for count in (-1, 1.5, BIG * 10**400, "3", None):
        refused(lambda count=count: loop.path([0.9], count), "steps")
    turned = PLANE.closed_loop
    np.testing.assert_array_equal(turned.path([7.25, 0.5], 5), turned.path([0.25, 0.5], 5))


# Cells, columns, vectors ---------------------------------------------------------------------


def test_points_in_rows_are_located_or_named():
    partition = PLANE.partition
    points = np.random.default_rng(0).random((7, 2))
    expected = partition.locate(list(points.T))
    np.testing.assert_array_equal(partition.locate(points), expected)
    np.testing.assert_array_equal(partition.locate(points.T), expected)
    np.testing.assert_array_equal(partition.locate(points.reshape(7, 1, 2))[:, 0], expected)
    refused(lambda: partition.locate(points[:2]), "2 points or 2 axes", "list(X.T)")
    for wrong in (points.tolist(), np.zeros((3, 4)), [points[:, 0]], 7, None):
        refused(lambda wrong=wrong: partition.locate(wrong), "list(X.T)")
    line = RESULT.partition
    assert line.locate(np.array([[0.1], [0.9]])).tolist() == [0, 3]
    assert line.locate(np.array([[0.9]])).tolist() == [3]


@pytest.mark.parametrize("bad", [["a", "b"], [1j, 0], [None, 0], [BIG, 0], [True, False],
                                 [np.ones(3), np.ones(4)], [[0.1], ["x"]]], ids=ascii)  # fmt: skip
def test_what_is_no_image_is_not_located(bad):
    refused(lambda: RESULT.partition.locate(bad), "images")


@pytest.mark.parametrize("bad", ["a", [0.1, 0.2], [["a", "b"]], [[1j, 0]], [[0.1]], [[[0.1, 0.2]]]])
def test_what_is_no_state_becomes_none(bad):
    refused(lambda: PLANE.partition.states(bad), "images")
    assert PLANE.partition.states([[1.5, -0.25]]).tolist() == [[0.5, 0.75]]


def test_images_of_any_real_kind_are_located():
    for kind in (np.float32, ">f8", np.longdouble, np.float16):
        x = np.array([0.25, 0.75], kind)
        assert PLANE.partition.locate([x, 0.5]).tolist() == [25, 75]
    x = np.array([0.25, 0.75])
    x.setflags(write=False)
    assert PLANE.partition.locate([x[::-1], np.broadcast_to(0.5, 2)]).shape == (2,)


@pytest.mark.parametrize("bad", ["no", "true", 0, 1, 1.0, None, np.array([True, False])], ids=ascii)
def test_flags_are_true_or_false(bad, tmp_path):
    problem = made(steps())
    refused(lambda: lm.solve(problem, require_all=bad), "require_all")
    refused(lambda: lm.solve(problem, restrict_to_gamma=bad), "restrict_to_gamma")
    refused(lambda: lm.explain(problem, phase_one=bad), "phase_one")
    refused(lambda: lm.verify(tmp_path, exact=bad), "exact")
    if bad is not None:
        refused(lambda: PLANE.partition.locate([0.1, 0.1], clip=bad), "clip")
    assert lm.solve(problem, require_all=np.True_).verified


@pytest.mark.parametrize("bad", [-1, 4, BIG, 1.5, "a", None, [1.5], [[0, 1]], [-1], [4], [BIG],
                                 ["a"], [True], {}], ids=ascii)  # fmt: skip
def test_cells_are_indices_in_range(bad):
    refused(lambda: RESULT.partition.centres(bad), "cell")
    if bad not in (-1, [-1]):  # no cell: no control
        refused(lambda: RESULT.controller.at(bad), "cell")
    refused(lambda: LOST.why(bad), "cell")


def test_columns_and_vectors_of_the_model_are_checked():
    lp = RESULT.lp
    pair = lp.tree[1]
    np.testing.assert_array_equal(lp.under(pair).cost, lp.cost[pair])
    for bad in (
        pair[:-1],
        pair[::-1],
        pair + lp.K,
        pair.astype(float),
        pair[:, None],
        None,
        7,
        "a",
    ):
        refused(lambda bad=bad: lp.under(bad), "policy")
    for bad in ([0, 0.5], [lp.K], [-1], None, "a"):
        refused(lambda bad=bad: lp.part(bad, np.arange(lp.n)), "columns")
    for bad in ([lp.n], [-1], None, [0.5]):
        refused(lambda bad=bad: lp.part(pair, bad), "inside")
    refused(lambda: lp.part(pair, [lp.n - 1]), "left out")
    for bad in (np.zeros(lp.n + 1), 7, None, np.zeros((lp.n, 1))):
        refused(lambda bad=bad: lp.expand(bad, 0, 0), "values")
    assert lp.expand([1.0] * lp.n, 0, 9).tolist() == [0, 1, 1, 1]
    for cell, control in ((BIG, 0), (1, BIG), (-1, 0), (1, -1)):
        assert lp.column(cell, control) is None


def test_boxes_of_a_cost_are_checked():
    for bad in (7, "x", [0, 1], {"y": (0, 1)}, {"x": 7}, {"x": (1, 0)}, {"x": (0, "a")},
                {"x": (0, np.nan)}, {"x": (0, 1, 2)}, {"x": (0, 10**400)},
                {"x": None}):  # fmt: skip
        refused(lambda bad=bad: RESULT.cost_from(bad), "boxes[0]")
    assert RESULT.cost_from({"x": np.array([0.25, 1.0])}) == RESULT.cost_from({"x": (0.25, 1)})
    assert RESULT.cost_from({"x": (-np.inf, np.inf)}).mass == pytest.approx(1)


# Objects and paths of the wrong kind ----------------------------------------------------------


@pytest.mark.parametrize("bad", [7, None, "x.json", [1], {"a": 1}, RESULT.certificate, object()],
                         ids=lambda x: type(x).__name__)  # fmt: skip
def test_arguments_of_another_kind_are_named(bad, tmp_path):
    plots = lm.plotting
    for call in (
        lm.compile, lm.solve, lm.gamma_max, lm.explain, lm.compare, plots.portrait, plots.cost,
        plots.causes, plots.control, plots.measure, plots.trajectories, plots.figure,
        lambda x: lm.exports.export_certificate(x, tmp_path / "c"), lm.backends.missing,
        lambda x: lm.exports.export_drn(x, tmp_path / "d"), lm.testing.check_backend,
        lm.backends.resolve, lm.interop.policy,
        lambda x: lm.exports.export_c(x, tmp_path / "h"),
        lambda x: lm.exports.export_csv(x, tmp_path / "t"),
        lambda x: lm.exports.export_onnx(x, tmp_path / "o"),
        lambda x: lm.exports.export_umb(x, tmp_path / "u"),
    ):  # fmt: skip
        refused(lambda call=call: call(bad))


@pytest.mark.parametrize(
    "bad", [7, None, [1], object(), "a\0b", 1.5], ids=lambda x: type(x).__name__
)
def test_paths_of_another_kind_are_named(bad, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for call in (
        RESULT.save, lm.Result.load, lm.verify, lm.load, RESULT.problem.save, RESULT.lp.write_mps,
        lambda path: lm.exports.export_certificate(RESULT, path),
        lambda path: lm.exports.export_drn(RESULT.lp, path),
        lambda path: lm.exports.export_umb(RESULT.lp, path),
        lambda path: lm.exports.export_c(RESULT, path),
        lambda path: lm.exports.export_csv(RESULT, path),
        lambda path: lm.plotting.figure(PLANE, path) if path is not None else lm.load(path),
    ):  # fmt: skip
        refused(lambda call=call: call(bad), "path")
    assert not list(tmp_path.iterdir())


def test_paths_in_bytes_are_paths(tmp_path):
    RESULT.save(str(tmp_path / "out").encode())
    assert lm.Result.load(str(tmp_path / "out").encode()).cost == RESULT.cost


@pytest.mark.parametrize("bad", [7, "x", [1]], ids=ascii)
def test_a_progress_that_cannot_be_called_is_named(bad):
    for call in (lm.compile, lm.solve, lm.gamma_max, lm.explain, lm.compare):
        refused(lambda call=call: call(RESULT.problem, progress=bad), "progress")


def test_choices_of_a_plot_are_checked():
    lorenz = SimpleNamespace(names=tuple(NAMED["lorenz"].formulas))
    assert len(lorenz.names) == 3
    for axes in (7, "x", ["z"], [], ["x", "x"], [7], {"x": 1}):
        refused(lambda axes=axes: lm.plotting.cost(PLANE, axes=axes), "axes")
    for at in (7, "x", ["x"], {"z": 1}, {"y": "a"}, {"y": None}, {"y": 10**400}, {"x": 0.5}):
        refused(lambda at=at: lm.plotting.cost(PLANE, axes=["x"], at=at))
    for control in ("a", [1, 2], {"v": 1}, [None], 10**400, np.nan, True):
        refused(lambda control=control: lm.plotting.portrait(PLANE, control), "control")
    for name in (7, "nonsense", ["u"], True):
        refused(lambda name=name: lm.plotting.control(PLANE, name))
