"""The controller as an ONNX graph, computed by ONNX Runtime: the same bits as in Python."""

import numpy as np
import pytest
from c_controller import states
from problems import doubling, made, standard_map
from test_c_header import LAWS

import lmdsl as lm

pytest.importorskip("onnx")


@pytest.fixture(scope="module", params=LAWS)
def result(request) -> lm.Result:
    return lm.solve(made(LAWS[request.param]))


def test_the_runtime_gives_the_same_bits(result, tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    lm.exports.export_onnx(result, tmp_path / "controller.onnx")
    session = runtime.InferenceSession(tmp_path / "controller.onnx")
    x = states(result, 100_000)
    u, index = session.run(["u", "index"], {"x": x})
    np.testing.assert_array_equal(u, result.controller(x))
    plain = (index >= 0) & (index < len(result.control_vectors))
    np.testing.assert_array_equal(u[plain], result.control_vectors[index[plain]])
    assert (index == len(result.control_vectors)).any() == (result.controller.local is not None)
    about = session.get_modelmeta().custom_metadata_map
    assert about["model"] == result.lp.digest
    assert about["states"].split(",") == list(result.problem.states)


def test_the_reference_of_onnx_gives_the_same(result, tmp_path):
    import onnx
    from onnx.reference import ReferenceEvaluator

    lm.exports.export_onnx(result, tmp_path / "controller.onnx")
    model = onnx.load(tmp_path / "controller.onnx")
    onnx.checker.check_model(model, full_check=True)
    x = states(result, 2_000)
    with np.errstate(all="ignore"):
        u, _ = ReferenceEvaluator(model).run(["u", "index"], {"x": x})
    np.testing.assert_array_equal(u, result.controller(x))


def test_a_wrong_table_is_noticed(tmp_path, monkeypatch):
    runtime = pytest.importorskip("onnxruntime")
    result = lm.solve(made(standard_map(20)))
    from lmdsl.results.exports import onnx as exported

    right = exported.codes
    monkeypatch.setattr(exported, "codes", lambda law: np.where(right(law) == 3, 4, right(law)))
    lm.exports.export_onnx(result, tmp_path / "controller.onnx")
    session = runtime.InferenceSession(tmp_path / "controller.onnx")
    x = states(result, 20_000)
    (u,) = session.run(["u"], {"x": x})
    assert not np.array_equal(u, result.controller(x), equal_nan=True)


def test_without_controls_there_is_nothing_to_compute(tmp_path):
    with pytest.raises(lm.BadInput, match="no controls"):
        lm.exports.export_onnx(lm.solve(made(doubling())), tmp_path / "controller.onnx")
