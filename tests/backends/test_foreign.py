"""Strangers' backends: what they return is copied once, what they are given is theirs alone."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.backends import Backend, Capabilities, Options, Solution, Stop, registry
from lmdsl.backends.asking import ask
from lmdsl.cli import main
from lmdsl.machine import surroundings
from lmdsl.optimize.policies import evaluation, iteration
from lmdsl.optimize.policies.iteration import Iteration

PROBLEM = standard_map(10)


def foreign(function, **parts):
    return Backend("foreign", function, Capabilities(**parts))


@pytest.fixture(scope="module")
def lp():
    return lm.compile(made(PROBLEM))


@pytest.fixture(scope="module")
def truth(lp):
    return lm.solve(lp)


def asked(lp, function, **options):
    start = lp.tree[1].copy()
    return ask(lp, foreign(function), Options(start=start, **options))[0]


def optimal(lp, **parts):
    return Solution(Stop.OPTIMAL, "optimal", **parts)


# What comes back -----------------------------------------------------------------------------


class Agreeable(np.ndarray):
    """An array that finds every comparison true, and of which arithmetic gives itself."""

    def __array_ufunc__(self, ufunc, method, *inputs, **kwargs):
        if ufunc in (np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.isfinite):
            return np.ones(self.shape, dtype=bool)
        return self

    def __array_function__(self, function, types, args, kwargs):
        return self

    def astype(self, *_, **__):
        return self

    def all(self, *_, **__):
        return True

    def copy(self, *_, **__):
        return self


class Proxy:
    """No array; makes one when asked, of any kind."""

    def __init__(self, array):
        self.array = array
        self.asked = 0

    def __array__(self, dtype=None, copy=None):
        self.asked += 1
        return self.array if dtype is None else self.array.astype(dtype)


LIES = {
    "subclass": lambda a: a.view(Agreeable),
    "no array": Proxy,
    "matrix": np.asmatrix,
    "strided": lambda a: np.repeat(a, 2)[::2],
    "backwards": lambda a: a[::-1][::-1],
    "read-only": lambda a: np.frombuffer(a.tobytes(), a.dtype),
    "foreign bytes": lambda a: a.astype(a.dtype.newbyteorder()),
}


def exact(array, dtype):
    return (array is None) or (
        type(array) is np.ndarray
        and array.dtype == dtype
        and array.dtype.isnative
        and array.flags.c_contiguous
        and array.flags.aligned
        and array.base is None
    )


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("wrong", [False, True])
def test_arrays_are_copied_into_plain_ones(lp, truth, lie, wrong):
    value = truth.value[lp.cells] * (0.1 if wrong else 1.0)
    pair = lp.pair_pointer[:-1].copy()

    def claims(lp, options):
        theta = np.ones(lp.K)
        return optimal(lp, value=LIES[lie](value), occupation=LIES[lie](theta),
                       policy=LIES[lie](pair))  # fmt: skip

    found = asked(lp, claims)
    assert exact(found.value, np.float64)
    assert exact(found.occupation, np.float64)
    assert exact(found.policy, np.int64)
    result = lm.solve(lp, foreign(claims))
    assert result.status == "verified"
    assert result.cost == pytest.approx(truth.cost, rel=1e-9)
    np.testing.assert_array_equal(result.control_index, truth.control_index)


def test_an_array_that_finds_every_comparison_true_proves_nothing(lp, truth):
    def claims(lp, options):
        return optimal(
            lp, value=np.ones(lp.n).view(Agreeable), policy=lp.pair_pointer[:-1].view(Agreeable)
        )

    result = lm.solve(lp, foreign(claims))
    assert result.cost == pytest.approx(truth.cost, rel=1e-9)
    assert type(result.value) is np.ndarray


NO_NUMBERS = {
    "complex": lambda n: np.ones(n) + 1j,
    "boolean": lambda n: np.ones(n, dtype=bool),
    "dates": lambda n: np.full(n, np.datetime64(1, "s")),
    "durations": lambda n: np.full(n, np.timedelta64(1, "s")),
    "objects": lambda n: np.ones(n, dtype=object),
    "text": lambda n: np.full(n, "1.0"),
    "records": lambda n: np.ones(n, dtype=[("a", float)]),
    "masked": lambda n: np.ma.MaskedArray(np.ones(n), [True] + [False] * (n - 1)),
    "column": lambda n: np.ones((n, 1)),
    "scalar": lambda n: 1.0,
    "too long": lambda n: np.ones(n + 1),
    "infinite": lambda n: np.full(n, np.inf),
    "beyond doubles": lambda n: np.full(n, np.longdouble("1e400")),
    "generator": lambda n: (1.0 for _ in range(n)),
    "ragged": lambda n: [[1.0], [1.0, 2.0]],
    "dict": lambda n: dict.fromkeys(range(n), 1.0),
}


@pytest.mark.parametrize("kind", NO_NUMBERS)
def test_what_is_no_vector_of_finite_numbers_is_left_out(lp, kind):
    make = NO_NUMBERS[kind]
    found = asked(lp, lambda lp, o: optimal(lp, value=make(lp.n), occupation=make(lp.K)))
    assert found.value is None
    assert found.occupation is None
    assert asked(lp, lambda lp, o: optimal(lp, policy=make(lp.n))).policy is None


@pytest.mark.parametrize("bad", [np.uint64(2**63), np.int64(-1), np.uint64(2**64 - 1)])
def test_columns_far_away_are_no_policy(lp, bad):
    pair = lp.pair_pointer[:-1].astype(type(bad))
    pair[0] = bad
    assert asked(lp, lambda lp, o: optimal(lp, policy=pair)).policy is None


def test_arrays_that_are_changed_later_do_not_matter(lp, truth):
    value = truth.value[lp.cells].copy()
    pair = np.array(lp.tree[1])
    ended = threading.Event()

    def scribble():
        while not ended.is_set():
            value[:] = 1e9
            pair[:] = -1
            time.sleep(0.001)

    thread = threading.Thread(target=scribble)

    def claims(lp, options):
        thread.start()
        return optimal(lp, value=value, policy=pair)

    try:
        result = lm.solve(lp, foreign(claims))
    finally:
        ended.set()
        thread.join()
    assert result.status == "verified"
    assert result.cost == pytest.approx(truth.cost, rel=1e-9)


class Changing(Solution):
    """A solution that is another one each time it is looked at."""

    looked = 0

    def __getattribute__(self, name):
        if name == "policy":
            Changing.looked += 1
        return super().__getattribute__(name)


def test_each_part_is_read_once(lp):
    Changing.looked = 0
    asked(lp, lambda lp, o: Changing(Stop.OPTIMAL, "optimal", policy=lp.tree[1]))
    assert Changing.looked == 1


class Unspeakable:
    def __str__(self):
        raise RuntimeError("no")

    __repr__ = __str__


class Shouting(str):
    __slots__ = ()

    def __str__(self):
        return self

    def __format__(self, spec):
        return "verified"


@pytest.mark.parametrize("word", [None, 7, Unspeakable(), "a\nb\x1b[2J\x00c", "\ud800", "x" * 10**6,
                                  b"bytes", Shouting("loud"), ["list"]])  # fmt: skip
def test_words_become_one_printable_line(lp, word, capsys, tmp_path):
    result = lm.solve(lp, foreign(lambda lp, o: Solution(Stop.OPTIMAL, word, policy=lp.tree[1])))
    assert result.status == "verified"
    assert type(result.solver_status) is str
    assert result.solver_status.isprintable()
    assert len(result.solver_status) <= 200
    json.dumps(result.to_dict(), allow_nan=False).encode("utf-8")
    result.save(tmp_path / "out")


@pytest.mark.parametrize(("given", "kept"), [
    (3, 3), (np.int64(3), 3), (-1, None), (10**400, None), (2.0, None), (np.nan, None),
    ("many", None), (True, None), (np.array([3]), None), (Unspeakable(), None),
])  # fmt: skip
def test_iterations_are_a_count_or_nothing(lp, given, kept, tmp_path):
    def claims(lp, options):
        return Solution(Stop.OPTIMAL, "optimal", policy=lp.tree[1], iterations=given)

    result = lm.solve(lp, foreign(claims))
    assert (result.iterations, type(result.iterations)) == (kept, type(kept))
    result.save(tmp_path / "out")
    assert lm.Result.load(tmp_path / "out").iterations == kept


@pytest.mark.parametrize("stop", [None, "OPTIMAL", Stop, 0, Unspeakable()])
def test_a_stop_is_a_stop(lp, stop):
    assert asked(lp, lambda lp, o: Solution(stop, "optimal")).stop is Stop.FAILED


def test_details_prove_nothing(lp, truth):
    # What our own policy iteration hands on must not be forged: here a policy that is not optimal.
    def forger(lp, options):
        pair = lp.tree[1]
        value = evaluation.evaluate(lp, pair)
        screen = iteration.Screen(lp)
        claim = Iteration(pair, value, 0, True, screen)
        return Solution(Stop.OPTIMAL, "optimal", value, None, pair, 1, {"iteration": claim})

    assert (lp.tree[1] != truth.lp.column(0, 0)).any()
    result = lm.solve(lp, foreign(forger))
    assert result.status == "verified"
    assert result.polish_steps > 0
    assert result.cost == truth.cost
    own = lm.solve(lp, replace(lm.backends.get("policy-iteration"), name="own"))
    assert own.polish_steps == 0
    for details in (None, 7, {"iteration": Unspeakable()}, Unspeakable()):
        found = asked(lp, lambda lp, o, d=details: Solution(Stop.OPTIMAL, "", details=d))
        assert dict(found.details) == {}


# What is raised ------------------------------------------------------------------------------


class Silent(Exception):
    def __str__(self):
        raise SystemExit(0)


class Panic(BaseException):
    pass


@pytest.mark.parametrize("error", [
    SystemExit(0), SystemExit("bye"), GeneratorExit(), Silent(), Panic(Unspeakable()),
    MemoryError(), RecursionError(), StopIteration(), ExceptionGroup("many", [ValueError()]),
    Warning("w"), AssertionError(), OSError(28, "full"),
])  # fmt: skip
def test_whatever_is_raised_is_a_failure_and_no_exit(lp, truth, error):
    def fails(lp, options):
        raise error

    result = lm.solve(lp, foreign(fails))
    assert result.status == "verified"  # polished from the first policy
    assert result.cost == pytest.approx(truth.cost, rel=1e-9)
    assert type(error).__name__ in result.solver_status
    assert result.solver_status.isprintable()


def test_what_is_raised_while_the_answer_is_read_is_a_failure(lp):
    class Trap:
        def __array__(self, dtype=None, copy=None):
            raise SystemExit(0)

    found = asked(lp, lambda lp, o: optimal(lp, value=Trap()))
    assert found.stop is Stop.FAILED
    assert "SystemExit" in found.word


def test_the_refusal_of_a_stranger_is_said_on_one_line(lp):
    def refuses(lp, options):
        raise lm.BadInput("not\x1b[2J\nme", Unspeakable)

    with pytest.raises(lm.BadInput) as refused:
        lm.solve(lp, foreign(refuses))
    assert str(refused.value).isprintable()


def test_an_interrupt_goes_through(lp):
    def waits(lp, options):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            lm.solve(lp, foreign(waits))
    finally:
        signal.signal(signal.SIGINT, before)


class Alarm(Exception):
    pass


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="no alarms on this system")
@pytest.mark.parametrize("error", [Alarm("late"), SystemExit(143)])
def test_what_a_signal_handler_raises_goes_through(lp, error):
    def ring(*_):
        raise error

    def waits(lp, options):
        signal.raise_signal(signal.SIGALRM)
        return optimal(lp)

    before = signal.signal(signal.SIGALRM, ring)
    try:
        with pytest.raises(type(error)):
            lm.solve(lp, foreign(waits))
    finally:
        signal.signal(signal.SIGALRM, before)


# What is handed out --------------------------------------------------------------------------


def unlocked(array):
    """Make an array writeable, whatever that takes."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    array.flags.writeable = True
    return array


def vandalise(lp, options):
    arrays = [lp.cost, lp.control, lp.pair_pointer, lp.cells, lp.cell_status, lp.weight,
              lp.controls, lp.rows.target, lp.rows.code, lp.rows.pointer, lp.rows.shares.value,
              lp.partition.low, lp.partition.cells, lp.cell, *lp.tree, options.start]  # fmt: skip
    for array in arrays:
        unlocked(array)[...] = 0
    if options.proof is not None:
        unlocked(options.proof)[...] = 1e300
    object.__setattr__(lp, "gamma", 0.5)
    vars(lp)["tree"] = None
    return Solution(Stop.OPTIMAL, "optimal")


@pytest.mark.parametrize("elimination", [False, True])
def test_a_backend_that_unlocks_the_model_spoils_its_own_copy(truth, elimination):
    lp = lm.compile(made(PROBLEM))
    digest = lp.digest
    del vars(lp)["digest"]
    result = lm.solve(lp, foreign(vandalise, elimination=elimination))
    assert lp.digest == digest
    assert result.status == "verified"
    assert result.cost == truth.cost
    np.testing.assert_array_equal(result.control_index, truth.control_index)


def spoil_gamma(problem):
    vars(problem)["gamma"] = 0.5


def spoil_cost(problem):
    vars(problem)["stage_cost"] = "0*x"


def spoil_parameters(problem):
    dict.__setitem__(problem.system.parameters, "K", 9.0)


def spoil_box(problem):
    vars(problem.state_box["x"])["high"] = 77.0


def spoil_axes(problem):
    dict.pop(problem.state_box, "x")


@pytest.mark.parametrize(
    "spoil", [spoil_gamma, spoil_cost, spoil_parameters, spoil_box, spoil_axes]
)
def test_a_backend_that_changes_the_problem_spoils_its_own_copy(truth, spoil, tmp_path):
    def spoils(lp, options):
        spoil(lp.problem)
        return optimal(lp, policy=lp.tree[1])

    problem = made(PROBLEM)
    lp = lm.compile(problem)
    result = lm.solve(lp, foreign(spoils))
    assert problem == made(PROBLEM)
    assert result.problem is problem
    assert result.cost == truth.cost
    result.save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds


def test_the_function_of_a_problem_is_not_copied():
    class Map:
        def __call__(self, x, u):
            return [x - 0.25 * u]

        def __deepcopy__(self, memo):
            raise TypeError("cannot be copied")

    problem = made(steps()).replaced(system=lm.systems.FunctionSystem(next=Map()))
    seen = []

    def looks(lp, options):
        seen.append(lp.problem.system.next)
        return optimal(lp, policy=lp.tree[1])

    assert lm.solve(problem, foreign(looks)).solver_status == "optimal"
    assert seen == [problem.system.next]


def test_a_backend_that_goes_on_in_a_thread_does_not_matter(lp, truth):
    ended = threading.Event()
    threads = []

    def claims(lp, options):
        def scribble():
            while not ended.is_set():
                unlocked(lp.cost)[...] = 0
                unlocked(lp.rows.target)[...] = 0
                time.sleep(0.001)

        threads.append(threading.Thread(target=scribble))
        threads[0].start()
        return optimal(lp, policy=lp.tree[1])

    try:
        result = lm.solve(lp, foreign(claims))
    finally:
        ended.set()
        threads[0].join()
    assert result.cost == truth.cost


def test_numpys_settings_are_restored(lp, truth):
    def sets(lp, options):
        np.seterr(all="raise")
        return optimal(lp, value=np.full(lp.n, 1e308), occupation=np.full(lp.K, 1e-320))

    before = np.geterr()
    assert lm.solve(lp, foreign(sets)).cost == pytest.approx(truth.cost, rel=1e-9)
    assert np.geterr() == before


@pytest.mark.skipif(
    not (sys.platform == "linux" and platform.machine() == "x86_64"), reason="codes of x86-64 Linux"
)
@pytest.mark.parametrize("mode", [0x400, 0x800, 0xC00, "denormals"])
def test_rounding_is_restored(lp, truth, mode):
    libm = ctypes.CDLL("libm.so.6")

    def sets(lp, options):
        if mode == "denormals":
            state = (ctypes.c_uint32 * 8)()
            libm.fegetenv(state)
            state[7] |= 0x8040  # flush to zero, denormals are zero
            libm.fesetenv(state)
        else:
            libm.fesetround(mode)
        assert not surroundings._rounds_to_nearest()
        return optimal(lp, value=np.ones(lp.n))

    try:
        assert lm.solve(lp, foreign(sets)).cost == pytest.approx(truth.cost, rel=1e-9)
        assert surroundings._rounds_to_nearest()
        sets(lp, None)
        surroundings.restore_rounding("the test")
        assert surroundings._rounds_to_nearest()
    finally:
        libm.fesetenv(ctypes.c_void_p(-1))


def test_rounding_that_cannot_be_restored_is_said(monkeypatch):
    monkeypatch.setattr(surroundings, "_rounds_to_nearest", lambda: False)
    with pytest.raises(lm.LmdslError, match="the backend changed how this processor rounds"):
        surroundings.restore_rounding("the backend")


# Packages that offer backends ----------------------------------------------------------------

BROKEN = {
    "absent": ("absent = no_such_package.module:BACKEND", "no_such_package"),
    "raises": ("raises = broken_package:RAISES", "kaboom"),
    "exits": ("exits = broken_exit:BACKEND", "SystemExit"),
    "number": ("number = broken_package:NUMBER", "no lmdsl.backends.Backend"),
    "attribute": ("attribute = broken_package:NOTHING", "AttributeError"),
    "record": ("record = broken_package:RECORD", "record is broken"),
    "names": ("names = broken_package:NAMES", "record is broken"),
    "nameless": ("nameless = broken_package:NAMELESS", "record is broken"),
    "inside": ("inside = broken_package:INSIDE", "missing_parent.child"),
    "inside failing": ("failing = broken_package:FAILING", "broken_parent.child"),
    "inside exiting": ("exiting = broken_package:EXITING", "broken_exit.child"),
    "twice": ("twice = broken_package:GOOD", "offered by"),
    "bad name": ("bad\x1b[2Jname = broken_package:GOOD", "no name"),
    "with:colon": ("with:colon = broken_package:GOOD", "no name"),
}

PACKAGE = """
from lmdsl.backends import Backend, Capabilities, Solution, Stop
NUMBER = 7
def solve(lp, options):
    return Solution(Stop.OPTIMAL, "optimal", policy=lp.tree[1])
GOOD = Backend("good", solve)
RECORD = Backend("record", solve, capabilities=None)
NAMES = Backend("names", solve, Capabilities(algorithms=(1, "\\x1b")))
NAMELESS = Backend(None, solve)
INSIDE = Backend("inside", solve, requires=("missing_parent.child",))
FAILING = Backend("failing", solve, requires=("broken_parent.child",))
EXITING = Backend("exiting", solve, requires=("broken_exit.child",))
def __getattr__(name):
    if name == "RAISES":
        raise RuntimeError("kaboom\\x1b[2J")
    raise AttributeError(name)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder of installed packages, most of them broken."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "broken_package.py").write_text(PACKAGE)
    (folder / "broken_exit.py").write_text("import sys; sys.exit(0)")
    (folder / "broken_parent").mkdir()
    (folder / "broken_parent" / "__init__.py").write_text("raise RuntimeError('kaboom')")
    lines = [line for line, _ in BROKEN.values()]
    for name, entries in (
        ("broken", [*lines, "good = broken_package:GOOD", "highs = broken_package:NUMBER"]),
        ("second", ["twice = broken_package:NUMBER"]),
    ):
        info = folder / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("\n".join(["[lmdsl.backends]", *entries]))
    nameless = folder / "nameless-1.0.dist-info"
    nameless.mkdir()
    (nameless / "entry_points.txt").write_text("[lmdsl.backends]\nanonymous = nowhere:BACKEND")
    return folder


@pytest.fixture
def installed(site, monkeypatch):
    monkeypatch.syspath_prepend(str(site))


def test_a_broken_package_breaks_no_other(installed, capsys, lp):
    assert main(["backends", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed["good"]["available"]
    assert listed["highs"]["available"]
    assert not listed["anonymous"]["available"]
    assert main(["backends"]) == 0
    text = capsys.readouterr().out
    assert all(line.isprintable() for line in text.splitlines())
    assert lm.solve(lp, "good").status == "verified"
    assert lm.solve(lp, "highs").status == "verified"


@pytest.mark.parametrize("text", ["no value\n", "[lmdsl.backends]\nno value\n", "[x\n", "= 7\n"])
def test_entry_points_that_cannot_be_read_hide_no_other(
    installed, tmp_path, monkeypatch, capsys, lp, text
):
    info = tmp_path / "unreadable-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: unreadable\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert main(["backends", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["good"]["available"]
    assert lm.solve(lp, "good").status == "verified"
    with pytest.raises(lm.BadInput, match="offered by"):
        lm.backends.get("twice")


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_said_with_the_package(installed, name):
    line, reason = BROKEN[name]
    with pytest.raises(lm.BadInput) as refused:
        lm.backends.get(line.split(" = ")[0])
    assert reason in str(refused.value)
    assert str(refused.value).isprintable()
    if not name.startswith("inside"):
        assert "broken" in str(refused.value)


def test_an_extra_that_is_missing_is_named(monkeypatch, lp):
    monkeypatch.setattr(registry, "_found", lambda package: package != "casadi")
    assert "ipopt" not in lm.backends.installed()
    assert "ipopt" in lm.backends.names()
    with pytest.raises(lm.BadInput, match="ipopt needs the package casadi"):
        lm.solve(lp, "ipopt")


@pytest.mark.parametrize("spec", [None, 7, b"highs", ["highs"], "", ":", "highs:", "\x1b[2J"])
def test_what_names_no_backend_is_bad_input(lp, spec):
    if spec == "highs:":
        assert lm.backends.resolve(spec)[1] is None
        return
    with pytest.raises(lm.BadInput) as refused:
        lm.solve(lp, spec)
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("broken", [
    Backend(None, lambda lp, o: None), Backend("a", 7), Backend("a", lambda lp, o: None, None),
    Backend("a", lambda lp, o: None, Capabilities(algorithms=5)),
    Backend("a\n", lambda lp, o: None), Backend("a", lambda lp, o: None, requires=(Unspeakable(),)),
])  # fmt: skip
def test_a_backend_with_a_broken_record_is_bad_input(lp, broken):
    with pytest.raises(lm.BadInput, match="record is broken"):
        lm.solve(lp, broken)


def test_a_backend_that_exits_does_not_end_the_command(site, tmp_path):
    (site / "quitting.py").write_text(
        "import sys\nfrom lmdsl.backends import Backend\n"
        "BACKEND = Backend('quits', lambda lp, o: sys.exit(0))\n"
    )
    made(steps()).save(tmp_path / "p.json")
    code = (
        "import sys; from lmdsl.cli import main\n"
        "import lmdsl.backends as b, quitting\n"
        "b.BUILT_IN['quits'] = 'quitting'\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "solve", str(tmp_path / "p.json"), "--backend", "quits",
         "--json"], capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *sys.path])},
    )  # fmt: skip
    assert done.returncode == 0
    assert json.loads(done.stdout)["status"] == "verified"
    assert "SystemExit" in json.loads(done.stdout)["solver_status"]
