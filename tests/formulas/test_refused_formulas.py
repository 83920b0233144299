"""What is no formula is refused where it stands; lengths, depths and names have limits."""

from __future__ import annotations

import ast
import functools
import pickle

import numpy as np
import pytest
from formula_texts import NAMES, formula_or_refusal, refused, same_bits, value
from hypothesis import given, settings
from hypothesis import strategies as st
from spent import at_most

from lmdsl.errors import BadInput
from lmdsl.formulas.language import Formula, check_name, parse
from lmdsl.formulas.tokens import FormulaError

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
    ("x if y else u", 2, "keyword"), ("x and y", 0, "'x' is not a comp"),
    ("x or y<1", 0, "'x' is not"), ("x<1 and y", 8, "'y' is not a comparison; write one"),
    ("not x", 4, "'x' is not a comparison"), ("x is y", 2, "keyword"), ("x in y", 2, "keyword"),
    ("True", 0, "keyword"), ("None", 0, "keyword"), ("await x", 0, "keyword"),
    ("x % y", 2, "'%'.*write mod"), ("x // y", 2, "'//'.*floor"),
    ("x ^ y", 2, r"'\^'.*write \*\* for"),
    ("x @ y", 2, "'@'"),
    ("x & y", 2, "'&'"), ("x | y", 2, r"'\|'"), ("~x", 0, "'~'"), ("x << 2", 3, "'<'"),
    ("x # a comment", 2, "'#'"), ("x\n+ y", 1, r"'\\n'"), ("x\r", 1, r"'\\r'"),
    ("x\x0c+y", 1, r"'\\x0c'"), ("x\x00", 1, r"'\\x00'"), ("x\u00a0+ y", 1, r"'\\xa0'"),
    ("x\\\ny", 1, r"'\\\\'"), ("'x'", 0, "language"), ('"x"', 0, "language"), ("`x`", 0, "'`'"),
    ("x; y", 1, "';'"), ("x, y", 1, "','"), ("x,", 1, "','"), (",x", 0, "','"), ("$x", 0, r"'\$'"),
    ("x?", 1, r"'\?'"), ("x!", 1, "'!'"), ("x <> y", 2, "'<>'.*!="),
    ("...", 0, "'.'"), (".", 0, "'.'"),
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
    ("x<y and y<u", 4, "comparison"), ("x + not y<1", 4, "brackets"), ("not", 3, "ends"),
    ("where(x<1 and,1,2)", 13, "','"), ("where(and x<1,1,2)", 6, "'and'"), ("and", 0, "'and'"),
    ("where(x<1 and (y), 1, 2)", 14, "comparison"), ("where(not x,1,2)", 10, "'x' is not"),
    ("where((not x<1) + 1,1,2)", 7, "comparison"), ("where(x < not y<1,1,2)", 10, "brackets"),
    ("where(1/0>0 and x<1,1,2)", 6, "'1/0'"), ("where(x<1 or 2,1,2)", 13, "'2' is not"),
    ("where(x<1 && y<1,1,2)", 10, "'&&'.*write and"), ("where(x<1 || y<1,1,2)", 10, "write or"),
    ("where(x<1 AND y<1,1,2)", 10, "write and"), ("where(x<1 Or y<1,1,2)", 10, "write or"),
    ("where(!(x<1),1,2)", 6, "write not"), ("where(x=1,1,2)", 7, "write == to"),
    ("mod", 0, "function"), ("mod(x)", 0, "2 arguments"), ("mod(1, 0)", 0, "not a number"),
    ("mod x", 0, "function"), ("x + y (mod 1)", 6, "declare the axis periodic"),
    ("np.sin(x)", 0, "write sin"), ("math.pi", 0, "write pi"), ("np.arctan2(x, y)", 0, "atan2"),
    ("np.power(x, 2)", 0, r"write x\*\*y"), ("numpy.nothing(x)", 0, "language"),
    ("arcsin(x)", 0, "mean 'asin'"), ("ln(x)", 0, "mean 'log'"), ("Pi*x", 0, "mean 'pi'"),
    ("pow(x, 2)", 0, r"write x\*\*y"), ("fmod(x, 1)", 0, "mean 'mod'"), ("U*x", 0, "mean 'u'"),
    ("|x|", 0, r"write abs\(x\)"), ("x\u00b2 + 1", 1, r"write \*\*2"), ("2\u03c0", 1, "language"),
    ("where(x<y<u,1,2)", 9, "one comparison"), ("where((x<y)<u,1,2)", 11, "one comparison"),
    ("where(x<(y<u),1,2)", 10, "comparison"), ("where(x,1,2)", 6, "'x' is not a comparison"),
    ("where((x),1,2)", 6, r"'\(x\)' is not a comparison"), ("where(1,1,2)", 6, "not a comparison"),
    ("where(-(x<1),1,2)", 9, "comparison"), ("where(+(x<1),1,2)", 9, "comparison"),
    ("where(where(x<1,1,2),1,2)", 6, "not a comparison"), ("where(x=1,1,2)", 7, "'='"),
    ("where(x< =1,1,2)", 9, "'='"), ("where(x<1,1)", 0, "3 arguments, not 2"),
    ("where(x<1)", 0, "3 arguments, not 1"), ("where(x<1,1,2,3)", 0, "3 arguments, not 4"),
    ("where()", 0, "not 0"), ("where", 0, "function"), ("where(x not in y,1,2)", 8, "'not' stands"),
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
    ("u + sinn(x)", 4, "'sinn' is not a declared name or function; did you mean 'sin'. declared"),
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
        "character 7: 'sinn' is not a declared name or function; did you mean 'sin'? declared "
        "names are u, x, y"
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
