"""The controller as a C header: compiled, it gives what Python gives, to the same bits."""

import numpy as np
import pytest
from c_controller import COMPILER, CompiledController, states
from problems import made, standard_map

import lmdsl as lm
from lmdsl.results.exports import c

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def result() -> lm.Result:
    return lm.solve(made(standard_map(20)))


@needs_compiler
def test_it_is_the_controller_to_the_same_bits(result, tmp_path):
    x = states(result, 20_000)
    u, index = CompiledController(result, tmp_path)(x)
    np.testing.assert_array_equal(u, result.controller(x))
    assert ((index >= 0) == ~np.isnan(u[:, 0])).all()


@pytest.mark.parametrize("bits", range(1, 33))
def test_packed_codes_are_read_as_they_were(bits):
    code = np.random.default_rng(bits).integers(0, 2**bits, 100)
    words = c.packed(code, bits).astype(object)
    at = np.arange(100) * bits
    read = [(words[k // 32] | words[k // 32 + 1] << 32) >> k % 32 & (2**bits - 1) for k in at.tolist()]
    assert read == code.tolist()


def test_the_smaller_table_is_written():
    assert c.table(np.repeat([0, 1], 10_000)).name == "runs"
    assert c.table(np.resize([0, 1], 10_000)).name == "bits"
