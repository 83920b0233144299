"""Formulas: an independent evaluation must agree to the bit, all else must be refused."""

from __future__ import annotations

import ast
import functools
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from spent import at_most

from lmdsl.errors import BadInput
from lmdsl.formulas import language
from lmdsl.formulas.language import (
    FORMULA_CONSTANTS,
    FORMULA_FUNCTIONS,
    Formula,
    FormulaError,
    check_name,
    parse,
)
from lmdsl.formulas.program import Program

NAMES = ("u", "x", "y")
UFUNCS = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos,
    "atan": np.arctan, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh, "exp": np.exp,
    "log": np.log, "sqrt": np.sqrt, "abs": np.abs, "sign": np.sign, "floor": np.floor,
    "ceil": np.ceil, "atan2": np.arctan2, "min": np.minimum, "max": np.maximum,
    "where": np.where,
}  # fmt: skip


def value(text, constants=None, **names):
    """The value of one formula; all given names are declared."""
    declared = set(names) | set(constants or {})
    return Program([parse(text, declared)], constants or {})(names)[0]


def refused(text, names=NAMES):
    with pytest.raises(FormulaError) as caught:
        parse(text, names)
    return caught.value


def formula_or_refusal(text):
    try:
        return parse(text, NAMES)
    except FormulaError as error:
        return error


def same_bits(left, right):
    left, right = np.broadcast_arrays(left, right)
    numbers = ~np.isnan(left)
    return (
        np.array_equal(left, right, equal_nan=True)
        and np.array_equal(np.signbit(left)[numbers], np.signbit(right)[numbers])
    )  # fmt: skip


# An independent evaluation: Python's own parser, and a walk over its tree.


class Oracle:
    def __init__(self, names):
        self.names = names
        self.constant_fault = False

    def __call__(self, text):
        with np.errstate(all="ignore"):
            return self.walk(ast.parse(text.strip(), mode="eval").body)

    def walk(self, node):
        result = getattr(self, type(node).__name__)(node)
        if np.ndim(result) == 0 and not np.isfinite(result):
            self.constant_fault = True
        return result

    def Constant(self, node):
        return np.float64(node.value)

    def Name(self, node):
        return self.names.get(node.id, {"pi": math.pi, "e": math.e}.get(node.id))

    def UnaryOp(self, node):
        operand = self.walk(node.operand)
        return np.negative(operand) if isinstance(node.op, ast.USub) else operand

    def BinOp(self, node):
        left, right = self.walk(node.left), self.walk(node.right)
        if isinstance(node.op, ast.Pow):
            constant_two = np.ndim(right) == 0 and right == 2
            return left * left if constant_two else np.power(left, right)
        function = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply}
        return function.get(type(node.op), np.divide)(left, right)

    def Compare(self, node):
        assert len(node.ops) == 1
        left, right = self.walk(node.left), self.walk(node.comparators[0])
        return {
            ast.Lt: np.less, ast.LtE: np.less_equal, ast.Gt: np.greater,
            ast.GtE: np.greater_equal, ast.Eq: np.equal, ast.NotEq: np.not_equal,
        }[type(node.ops[0])](left, right)  # fmt: skip

    def Call(self, node):
        return UFUNCS[node.func.id](*[self.walk(argument) for argument in node.args])


def expressions():
    numbers = st.one_of(
        st.integers(0, 12).map(str),
        st.floats(0, 1e3, allow_subnormal=False).map(repr),
        st.sampled_from(["pi", "e", ".5", "2.", "1e-3", "5E+1", "00", "0.0", "2", "007.5"]),
    )
    leaves = st.one_of(numbers, st.sampled_from(NAMES), st.sampled_from(NAMES))
    blanks = st.sampled_from(["", "", " ", "\t", "  "])

    def grow(inner):
        def call(arity):
            names = sorted(name for name, count in FORMULA_FUNCTIONS.items() if count == arity)
            return st.tuples(st.sampled_from(names), *[inner] * arity).map(
                lambda parts: f"{parts[0]}({','.join(parts[1:])})"
            )

        binary = st.tuples(inner, blanks, st.sampled_from(["+", "-", "*", "/", "**"]), inner)
        condition = st.tuples(
            inner, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), blanks, inner
        ).map("".join)
        condition |= condition.map("({})".format)
        return st.one_of(
            binary.map("".join),
            binary.map("".join),
            st.tuples(st.sampled_from(["-", "+", "- "]), inner).map("".join),
            inner.map("({})".format),
            call(1),
            call(2),
            st.tuples(condition, inner, inner).map(lambda p: f"where({p[0]}, {p[1]} ,{p[2]})"),
        )

    return st.recursive(leaves, grow, max_leaves=12)


POINTS = {
    "x": np.array([-1.5, -0.0, 0.3, 2.0, 7.25]),
    "y": np.array([[0.0], [-2.0], [0.5]]),
    "u": np.array([[[1.0]], [[-0.75]]]),
}


@settings(max_examples=400, deadline=None)
@given(expressions())
def test_agrees_to_the_bit_with_an_evaluation_through_python(text):
    oracle = Oracle(POINTS)
    expected = oracle(text)
    if oracle.constant_fault:
        refused(text)
        return
    before = {name: array.copy() for name, array in POINTS.items()}
    formula = parse(text, NAMES)
    (result,) = Program([formula])(POINTS)
    assert result.dtype == np.float64
    assert same_bits(result, expected)
    assert result.shape == np.broadcast_shapes((), *[POINTS[name].shape for name in formula.names])
    assert all(np.array_equal(before[name], POINTS[name]) for name in NAMES)


@settings(max_examples=100, deadline=None)
@given(st.lists(expressions(), min_size=2, max_size=4))
def test_formulas_compiled_together_agree_with_each_alone(texts):
    parsed = [f for f in map(formula_or_refusal, texts) if isinstance(f, Formula)]
    together = Program(parsed + parsed)(POINTS)
    alone = [Program([formula])(POINTS)[0] for formula in parsed]
    assert all(map(same_bits, together, alone + alone))
    for index, array in enumerate(together):  # fresh memory, theirs to change
        others = [*together[:index], *POINTS.values()]
        assert not any(np.shares_memory(array, other) for other in others)
        assert array.flags.writeable


@settings(max_examples=100, deadline=None)
@given(expressions(), st.floats(-5, 5), st.floats(-5, 5))
def test_parameters_folded_equal_constants_of_python(text, x, y):
    formula = formula_or_refusal(text)
    if isinstance(formula, Formula):
        folded = Program([formula], {"x": x, "y": y})
        assert folded.names <= {"u"}
        oracle = Oracle({"u": POINTS["u"], "x": np.float64(x), "y": np.float64(y)})
        assert same_bits(folded({"u": POINTS["u"]})[0], oracle(text))


# Known answers.


@pytest.mark.parametrize(
    "text",
    [
        "-x**2", "(-x)**2", "2**-1", "2**3**2", "(2**3)**2", "-2**-2", "2**-x**2", "2 - 3 - 4",
        "2 - (3 - 4)", "8/4/2", "8/(4/2)", "2*3+4*5", "2+3*4-5", "2/3*4", "2*x**2*3", "--x", "-+-x",
        "x*-y", "x- -y", "x**2**0.5", "1-x/y*2", "-x*y", "-x/-y", "+x**3", "x**-y", "x**+2",
        "1.", ".5", "1e3", "1.5E-2", "1.e2", "00", "0", "00.5", "09.5", "010e1", "5e+0",
        "\tx +\ty ", "((x))", "1+(2+(3+x))", "9007199254740993", "1e-400", "x - y + x - y",
    ],
)  # fmt: skip
def test_precedence_and_numbers_are_those_of_python(text):
    x, y = 1.7, 2.25
    expected = eval(text.strip(), {"__builtins__": {}}, {"x": x, "y": y})
    assert value(text, x=x, y=y) == pytest.approx(expected, rel=4e-16, abs=0)


def test_meaning_of_every_function_against_the_math_module():
    x, y = 0.4, -0.7
    for name, arity in FORMULA_FUNCTIONS.items():
        if arity == 1:
            reference = {"abs": abs, "sign": lambda t: math.copysign(1, t)}.get(name)
            reference = reference or getattr(math, name)
            assert value(f"{name}(x)", x=x) == pytest.approx(reference(x), rel=1e-15)
    assert value("abs(y) + sign(y)*8 + floor(y)*64 + ceil(y)", y=y) == abs(y) - 8 - 64
    assert value("atan2(y, x)", x=x, y=y) == pytest.approx(math.atan2(y, x), rel=1e-15)
    assert value("min(x, y)*10 + max(x, y)", x=x, y=y) == y * 10 + x
    assert value("pi", x=x) == math.pi
    assert value("e") == math.e
    assert dict(FORMULA_CONSTANTS) == {"pi": math.pi, "e": math.e}
    assert sorted(FORMULA_FUNCTIONS) == sorted(UFUNCS)


@pytest.mark.parametrize(
    ("operator", "expected"),
    [("<", [1, 0, 0]), ("<=", [1, 1, 0]), (">", [0, 0, 1]), (">=", [0, 1, 1]), ("==", [0, 1, 0]),
     ("!=", [1, 0, 1])],
)  # fmt: skip
def test_where_picks_by_each_comparison(operator, expected):
    x = np.array([0.0, 1.0, 2.0])
    assert value(f"where(x {operator} 1, 1, 0)", x=x).tolist() == expected
    assert value(f"where(((x {operator} 1)), 1, 0)", x=x).tolist() == expected


def test_where_may_nest_and_keeps_nan_out_of_the_branch_not_taken():
    x = np.array([-1.0, 0.0, 4.0])
    text = "where(x < 0, -1, where(x == 0, 0, log(x)/log(x)))"
    assert value(text, x=x).tolist() == [-1, 0, 1]
    assert value("where(where(x<0, 1, 2) > 1, sqrt(x), -x)", x=x).tolist() == [1, 0, 2]
    assert value("where(1 < 2, x, y)", x=x, y=np.ones((2, 1))).shape == (2, 3)


def test_results_that_are_not_finite_pass_silently_when_they_depend_on_names():
    x = np.array([0.0, -1.0])
    assert np.array_equal(value("1/x", x=x), [np.inf, -1.0])
    assert np.isnan(value("sqrt(x)", x=x)[1])
    assert np.isinf(value("exp(1e3*abs(x))", x=x)[1])


# Refusals.

HOSTILE = [
    # text, position counted from 0, what the message must say
    ("", 0, "empty"), ("   ", 0, "empty"), ("\t", 0, "empty"), ("\n", 0, r"'\\n'"),
    ("x.real", 1, "'.'"), ("x.__class__", 1, "'.'"), ("().__class__", 1, r"'\)'"),
    ("__import__('os')", 0, "__import__"), ("__builtins__", 0, "declared"),
    ("eval(x)", 0, "'eval'"), ("print(1)", 0, "'print'"), ("abs.x", 3, "'.'"),
    ("x[0]", 1, r"'\['"), ("[x]", 0, r"'\['"), ("{x}", 0, "'{'"), ("{}", 0, "'{'"),
    ("lambda: 0", 0, "keyword"), ("lambda x: x", 0, "keyword"), ("(x := 1)", 3, "':'"),
    ("x = 1", 2, "'='"), ("[x for x in y]", 0, r"'\['"), ("(x for x in y)", 3, "keyword"),
    ("x if y else u", 2, "keyword"), ("x and y", 2, "keyword"), ("x or y", 2, "keyword"),
    ("not x", 0, "keyword"), ("x is y", 2, "keyword"), ("x in y", 2, "keyword"),
    ("True", 0, "keyword"), ("None", 0, "keyword"), ("await x", 0, "keyword"),
    ("x % y", 2, "'%'"), ("x // y", 3, "'/'"), ("x ^ y", 2, r"'\^'.*write \*\* for"),
    ("x @ y", 2, "'@'"),
    ("x & y", 2, "'&'"), ("x | y", 2, r"'\|'"), ("~x", 0, "'~'"), ("x << 2", 3, "'<'"),
    ("x # a comment", 2, "'#'"), ("x\n+ y", 1, r"'\\n'"), ("x\r", 1, r"'\\r'"),
    ("x\x0c+y", 1, r"'\\x0c'"), ("x\x00", 1, r"'\\x00'"), ("x\u00a0+ y", 1, r"'\\xa0'"),
    ("x\\\ny", 1, r"'\\\\'"), ("'x'", 0, "language"), ('"x"', 0, "language"), ("`x`", 0, "'`'"),
    ("x; y", 1, "';'"), ("x, y", 1, "','"), ("x,", 1, "','"), (",x", 0, "','"), ("$x", 0, r"'\$'"),
    ("x?", 1, r"'\?'"), ("x!", 1, "'!'"), ("x <> y", 3, "'>'"), ("...", 0, "'.'"), (".", 0, "'.'"),
    ("\u0663", 0, r"u0663"), ("x + \u0661", 4, "u0661"), ("\uff58", 0, "uff58"),
    ("\uff53in(x)", 0, "uff53"), ("\u00e9", 0, "xe9"), ("x\u0301", 1, "u0301"),
    ("\u03c0", 0, "u03c0"), ("x\u00b2", 1, "xb2"), ("x \u2212 y", 2, "u2212"),
    ("x \u00d7 y", 2, "xd7"), ("\U0001d465", 0, "U0001d465"), ("\ud800", 0, "ud800"),
    ("\ufeffx", 0, "ufeff"), ("x\u200b", 1, "u200b"), ("\u202ex", 0, "u202e"),
    ("1_000", 0, "'1_000'"), ("0x10", 0, "'0x10'"), ("0b1", 0, "'0b1'"), ("0o7", 0, "'0o7'"),
    ("1j", 0, "'1j'"), ("2 + 3.5J", 4, "'3.5J'"), ("007", 0, "'007'"), ("x+01", 2, "'01'"),
    ("1e", 0, "'1e'"), ("1e+", 0, "'1e'"), ("1.2.3", 0, r"'1\.2\.3'"), ("1..real", 0, "1..real"),
    ("5.real", 0, "5.real"), ("1e5_0", 0, "'1e5_0'"), ("1if", 0, "'1if'"), ("2x", 0, "'2x'"),
    ("2 x", 2, "missing"), ("x y", 2, "missing"), ("2(x)", 1, "missing"), ("(x)(y)", 3, "missing"),
    ("x(2)", 1, "missing"), ("pi(2)", 2, "missing"), ("(x y)", 3, "missing"),
    ("sin(x)cos(x)", 6, "missing"), ("sin(x y)", 6, "missing"), ("x 2", 2, "missing"),
    ("1e999", 0, "too large"), ("x + 1e309", 4, "too large"), ("9" * 400, 0, "too large"),
    ("1/0", 0, "'1/0' is infinite"), ("-1/0", 0, "infinite"), ("0/0", 0, "not a number"),
    ("x + 1/0", 4, "'1/0' is infinite"), ("x*(2 - 2)**-1", 2, r"'\(2 - 2\)\*\*-1'"),
    ("log(0)", 0, "infinite"), ("log(-1)", 0, "not a number"), ("sqrt(-pi)", 0, "not a number"),
    ("(-8)**(1/3)", 0, "not a number"), ("exp(1000)", 0, "infinite"), ("10**400", 0, "infinite"),
    ("1e308*10*x", 0, "'1e308.10' is infinite"), ("x + 0*(1/0)", 7, "'1/0'"),
    ("9**9**9", 0, "infinite"), ("asin(2)", 0, "not a number"), ("max(1, 0/0)", 7, "'0/0'"),
    ("where(1/0>0,1,2)", 6, "'1/0'"), ("where(x>0,1/0,2)", 10, "'1/0'"),
    ("where(x>0,1,log(0))", 12, r"'log\(0\)'"), ("where(1<2, 1, 0/0)", 14, "'0/0'"),
    ("where(1<2, 1, 2)/0", 0, "infinite"),
    ("x<y", 1, "comparison"), ("(x<y)", 2, "comparison"), ("x + (y < 1)", 7, "comparison"),
    ("-(x<y)", 3, "comparison"), ("+(x<y)", 3, "comparison"), ("(x<y)**2", 2, "comparison"),
    ("2**(x<y)", 5, "comparison"), ("sin(x<y)", 5, "comparison"), ("min(x, y<1)", 8, "comparison"),
    ("where(x<1, y<1, 2)", 12, "comparison"), ("where(x<1, 2, y==1)", 15, "comparison"),
    ("where(x<y<u,1,2)", 9, "one comparison"), ("where((x<y)<u,1,2)", 11, "one comparison"),
    ("where(x<(y<u),1,2)", 10, "comparison"), ("where(x,1,2)", 6, "'x' is not a comparison"),
    ("where((x),1,2)", 6, r"'\(x\)' is not a comparison"), ("where(1,1,2)", 6, "not a comparison"),
    ("where(-(x<1),1,2)", 9, "comparison"), ("where(+(x<1),1,2)", 9, "comparison"),
    ("where(where(x<1,1,2),1,2)", 6, "not a comparison"), ("where(x=1,1,2)", 7, "'='"),
    ("where(x< =1,1,2)", 9, "'='"), ("where(x<1,1)", 0, "3 arguments, not 2"),
    ("where(x<1)", 0, "3 arguments, not 1"), ("where(x<1,1,2,3)", 0, "3 arguments, not 4"),
    ("where()", 0, "not 0"), ("where", 0, "function"), ("where(x not in y,1,2)", 8, "keyword"),
    ("sin", 0, "function"), ("sin x", 0, "function"), ("sin()", 0, "1 argument, not 0"),
    ("sin(x, y)", 0, "1 argument, not 2"), ("atan2(x)", 0, "2 arguments, not 1"),
    ("min(x)", 0, "not 1"), ("max(x, y, u)", 0, "not 3"), ("sin + 1", 0, "function"),
    ("sin(sin)", 4, "function"), ("sin(x,)", 6, r"'\)'"), ("min(x,y,)", 8, r"'\)'"),
    ("sin(,x)", 4, "','"), ("min(x y)", 6, "missing"), ("min(x;y)", 5, "';'"),
    ("sin(x=1)", 5, "'='"), ("atan2(y=1, x=2)", 7, "'='"), ("sin(*x)", 4, r"'\*'"),
    ("sin(**x)", 4, r"'\*\*'"), ("min((x, y))", 6, "','"), ("()", 1, r"'\)'"), ("(", 1, "ends"),
    (")", 0, r"'\)'"), ("(x", 2, "ends"), ("x)", 1, r"'\)'"), ("((x)", 4, "ends"),
    ("sin(x", 5, "ends"),
    ("x +", 3, "ends"), ("x + ", 4, "ends"), ("x + * y", 4, r"'\*'"), ("*x", 0, r"'\*'"),
    ("x ***y", 4, r"'\*'"), ("x** *2", 4, r"'\*'"), ("x * * 2", 4, r"'\*'"), ("-", 1, "ends"),
    ("x/", 2, "ends"), ("x++", 3, "ends"), ("x--", 3, "ends"), ("< x", 0, "'<'"),
    ("u + sinn(x)", 4, "'sinn' is not a declared name or function; declared names are u, x, y"),
    ("Sin(x)", 0, "'Sin'"), ("PI", 0, "'PI'"), ("nan", 0, "'nan'"), ("inf", 0, "'inf'"),
    ("z", 0, "declared names are u, x, y"), ("arcsin(x)", 0, "arcsin"), ("pow(x,2)", 0, "pow"),
    ("_", 0, "'_'"), ("x1", 0, "'x1'"), ("a" * 70, 0, "declared"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "position", "says"), HOSTILE)
def test_everything_else_is_refused_where_it_stands(text, position, says):
    with pytest.raises(FormulaError, match=says) as caught:
        parse(text, NAMES)
    assert caught.value.position == position
    message = str(caught.value)
    assert message.startswith(f"character {position + 1}: ")
    assert message.isprintable()
    assert message.isascii()
    assert isinstance(caught.value, BadInput | ValueError)


def test_message_of_the_first_fault_reads_as_promised():
    assert str(refused("u*x + sinn(x)")) == (
        "character 7: 'sinn' is not a declared name or function; declared names are u, x, y"
    )
    assert "no names are declared" in str(refused("x", ()))
    assert len(str(refused("z", [f"n{i}" for i in range(10_000)]))) < 300


def test_error_survives_pickling():
    error = refused("1 + z")
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.position) == (str(error), 4)


# Limits, exactly.


@pytest.mark.parametrize(
    ("left", "right", "levels"),
    [("(", ")", 1), ("sin(", ")", 1), ("-", "", 1), ("+", "", 1), ("x**", "", 1), ("1+(x*", ")", 1),
     ("x*(1+", ")", 1), ("min(y,", ")", 1), ("where(x<1,1,", ")", 1), ("where((", "<1),2,3)", 2),
     ("-sin(", ")", 2), ("2**-", "", 2), ("(-(", "))**2", 3)],
)  # fmt: skip
def test_depth_limit(left, right, levels):
    repeats, rest = divmod(50, levels)
    before, after = "-" * rest + left * repeats, right * repeats
    assert parse(f"{before}x{after}", NAMES).names == {"x", "y"} & set(before + "x")
    error = refused(f"{before}-x{after}")
    assert "deeper than 50" in str(error)
    assert error.position == len(before)


def test_depth_is_counted_in_nesting_and_not_in_what_stands_beside():
    inside = "(" * 49 + "x" + ")" * 49
    parse(f"{inside}+{inside}*-{inside}", NAMES)
    assert refused(f"{inside}+{inside}*--{inside}").position == 99 + 1 + 99 + 1 + 2 + 48


@pytest.mark.parametrize("hostile", ["(", "-", "sin(", "x**", "where(", "((-", "x<", "1+("])
def test_the_deepest_text_that_fits_is_refused_and_cheaply(hostile):
    with at_most(10):
        refused((hostile * 4000)[:4000])


@pytest.mark.parametrize("operator", ["+", "-", "*", "/"])
def test_flat_chains_are_limited_by_nodes_only(operator):
    text = operator.join(["x"] * 500)  # 500 names, 499 operators
    x = np.array([1.0, -0.999])
    function = {"+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide}[operator]
    assert same_bits(value(text, x=x), functools.reduce(function, [x] * 500))
    parse("-" + text, NAMES)
    error = refused("-" + text + operator + "x")
    assert "more than 1,000" in str(error)
    assert error.position == 1001


@pytest.mark.parametrize("extra", ["-", "+", "sin", "2", "x", "pi*"])
def test_node_limit_counts_signs_functions_and_numbers(extra):
    nodes = {"2": "2+", "x": "x+", "sin": "sin(x)+", "pi*": "pi*x+"}.get(extra, extra + "x+")
    count = {"sin": 3, "pi*": 4, "-": 3, "+": 3}.get(extra, 2)
    full, rest = divmod(1000, count)
    rest = {0: "x", 1: "x", 2: "-x", 3: "x"}[rest]
    text = nodes * (full - 1) + nodes[:-1]  # full*count - 1 nodes
    parse(text, NAMES)
    refused(text + "+" + rest + "+x")


def test_length_limit():
    parse("x".ljust(4000), NAMES)
    error = refused("x".ljust(4001))
    assert error.position == 4000
    assert "4,001" in str(error)
    assert "characters" in str(refused("(" * 10_000_000))


@settings(max_examples=300, deadline=None)
@given(st.text(max_size=60) | st.text("xyu0123456789.eE_ \t+-*/()<>=!,", max_size=40))
def test_arbitrary_text_is_a_formula_for_python_too_or_a_formula_error(text):
    formula = formula_or_refusal(text)
    if isinstance(formula, Formula):
        ast.parse(text.strip(), mode="eval")
        assert formula.names <= set(NAMES)
    else:
        assert 0 <= formula.position <= len(text)
        assert str(formula).startswith(f"character {formula.position + 1}: ")
        assert str(formula).isprintable()


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.sampled_from(
            ["x", "y", "2", "0", "sin", "min", "where", "(", ")", ",", "+", "-", "*", "**", "<",
             "==", "(x<1,", "(x)", " "]
        ),
        max_size=15,
    ).map("".join)
)  # fmt: skip
def test_arbitrary_tokens_are_a_formula_for_python_too_or_a_formula_error(text):
    if isinstance(formula_or_refusal(text), Formula):
        ast.parse(text.strip(), mode="eval")


@pytest.mark.parametrize(
    "name", ["x", "_", "K", "theta_1", "match", "type", "a" * 64, "inf", "__class__", "E", "Pi"]
)
def test_names_that_may_be_declared(name):
    check_name(name)
    assert parse(f"{name}*2", [name]).names == {name}


@pytest.mark.parametrize(
    "name",
    ["", " x", "x ", "1x", "a" * 65, "x-y", "x.y", "lambda", "None", "and", "sin", "where", "pi",
     "e", "min", "\u03b8", "\uff58", "x\n", "x\x00", "x\u0301", "\u0661"],
)  # fmt: skip
def test_names_that_may_not(name):
    with pytest.raises(BadInput) as caught:
        check_name(name)
    assert str(caught.value).isprintable()


# Programs.

STANDARD_MAP = ("x + y + K*u*sin(2*pi*x)", "y + K*u*sin(2*pi*x)")


def program(*texts, constants=None, names=(*NAMES, "K")):
    return Program([parse(text, names) for text in texts], constants or {})


def counting(monkeypatch, name):
    shapes = []
    original = language.OPERATIONS[name]

    def counted(*arguments, **keywords):
        result = original(*arguments, **keywords)
        shapes.append(np.shape(result))
        return result

    monkeypatch.setitem(language.OPERATIONS, name, counted)
    return shapes


def test_equal_steps_are_evaluated_once_and_in_the_smallest_shape(monkeypatch):
    compiled = program(*STANDARD_MAP, constants={"K": 0.25})
    assert compiled.names == {"u", "x", "y"}
    assert compiled.operations == ("+", "*", "*", "sin", "*", "+", "+")
    sines, products = counting(monkeypatch, "sin"), counting(monkeypatch, "*")
    x, y, u = np.ones((7, 1, 5)), np.ones((7, 1, 5)), np.ones((1, 3, 1))
    first, second = compiled({"x": x, "y": y, "u": u})
    assert sines == [(7, 1, 5)]
    assert products == [(1, 3, 1), (7, 1, 5), (7, 3, 5)]
    assert first.shape == second.shape == (7, 3, 5)


def test_sharing_is_to_the_bit_and_reorders_nothing():
    assert program("x*y", "y*x").operations == ("*", "*")
    assert program("x+y+u", "x+(y+u)").operations == ("+", "+", "+", "+")
    assert program("x*0", "x*(-0.0)", "x*0.0").operations == ("*", "*")
    assert program("sin(x)", "sin((x))", "+sin(x)").operations == ("sin",)
    assert program("x*(K/3)", "x*(1/3)", constants={"K": 1}).operations == ("*",)
    assert program("1/3 + 2*pi").operations == ()
    assert program("where(x<1,x,y) + where(x<1,x,y)").operations == ("<", "where", "+")
    zero, minus = program("x*0", "x*(-0.0)")({"x": np.ones(1)})
    assert np.signbit(minus)
    assert not np.signbit(zero)


def test_square_is_a_product_and_other_powers_are_powers():
    x = np.random.default_rng(0).normal(size=10_001) * 1e3
    assert same_bits(value("x**2", x=x), x * x)
    assert same_bits(value("x**2.0", x=x), x * x)
    assert same_bits(value("x**K", {"K": 2}, x=x), x * x)
    assert same_bits(value("x**-(-2)", x=x), x * x)
    for exponent in (0.5, 3.0, -1.0, 0.0):
        with np.errstate(invalid="ignore"):
            assert same_bits(value(f"x**{exponent}", x=x), np.power(x, exponent))


@pytest.mark.parametrize("name", sorted(FORMULA_FUNCTIONS))
def test_long_arrays_of_temporaries_have_the_bits_of_fresh_ones(name):
    x, y = np.random.default_rng(1).normal(size=(2, 4099)) * 3
    arguments = {1: "x*y", 2: "x*y, x-y", 3: "x*y < x-y, x/y, x+y"}[FORMULA_FUNCTIONS[name]]
    text = f"-(({name}({arguments}) + x*y)/(x+1) - sqrt(abs(x*2 - 1)))*floor(x*3)**2"
    expected = Oracle({"x": x, "y": y})(text)
    assert same_bits(value(text, x=x, y=y), expected)
    strided = np.repeat(x, 3)[::3]
    assert same_bits(value(text, x=strided, y=y), expected)


def test_memory_of_a_dead_temporary_is_used_again(monkeypatch):
    targets = []
    original = np.add

    def watched(*arguments, out=None):
        targets.append(out is not None)
        return original(*arguments, out=out)

    monkeypatch.setitem(language.OPERATIONS, "+", watched)
    x, y = np.ones((4, 1)), np.ones((1, 3))
    program("x + 1 + 2 + y + x")({"x": x, "y": y})
    # an input is never the target; then a temporary; then one too small; then one that fits
    assert targets == [False, True, False, True]
    targets.clear()
    first, second = program("x + 1", "(x + 1) + 2")({"x": x})
    assert targets == [False, False]  # the first result is kept
    assert (first[0], second[0]) == (2, 4)


def test_inputs_may_be_read_only_integers_scalars_and_broadcast_views():
    x = np.broadcast_to(np.arange(3), (4, 3))
    frozen = np.ones(3)
    frozen.flags.writeable = False
    results = program("x", "y", "x*y", "u", "u*2", "7", "-y", "y")({"x": x, "y": frozen, "u": 3})
    assert [array.shape for array in results] == [(4, 3), (3,), (4, 3), (), (), (), (3,), (3,)]
    assert all(isinstance(array, np.ndarray) and array.dtype == np.float64 for array in results)
    for array in results:
        array += 1
    assert frozen.tolist() == [1, 1, 1]
    assert x[0].tolist() == [0, 1, 2]


def test_a_program_is_used_many_times_without_memory_of_the_last():
    compiled = program("x + K*sin(x) + K", constants={"K": 2.0})
    for size in (3, 1, 5):
        x = np.linspace(0, 1, size)
        expected = x + 2.0 * np.sin(x) + 2.0
        assert same_bits(compiled({"x": x})[0], expected)
        assert same_bits(compiled({"x": x, "unused": np.ones(9)})[0], expected)


def test_a_missing_name_is_named():
    with pytest.raises(BadInput, match="no value is given for u, y;"):
        program("x + y + u")({"x": 1.0})


def test_parameters_may_make_what_is_not_finite():
    assert np.isposinf(program("1/K", constants={"K": 0})({})[0])
    assert np.isnan(program("x*log(K)", constants={"K": -1})({"x": np.ones(2)})[0]).all()
    assert program("where(K > 0, x/K, x)", constants={"K": 0})({"x": 3.0})[0] == 3


def test_formula_keeps_its_text_and_pickles():
    formula = parse(" x + K ", ("x", "K", "y"))
    assert (formula.text, formula.names) == (" x + K ", {"x", "K"})
    assert pickle.loads(pickle.dumps(formula)) == formula
    assert isinstance(formula, Formula)
    compiled = pickle.loads(pickle.dumps(Program([formula], {"K": 1.0})))
    assert compiled({"x": 2.0})[0] == 3


def test_a_no_op_formula_list_is_fine():
    assert Program([])({}) == ()


def test_a_large_program_compiles_and_runs_in_bounded_work():
    text = "+".join(f"sin({k}*x)" for k in range(199))  # 995 nodes
    with at_most(20):
        compiled = Program([parse(text, NAMES)] * 20)
        assert len(compiled.operations) == 199 * 2 + 198
        compiled({"x": np.ones(10)})
