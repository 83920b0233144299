"""What the page on other packages says of the functions."""

import inspect

import pytest
from pages import ROOT

import lmdsl as lm

PAGE = (ROOT / "docs/interop.md").read_text()


@pytest.mark.parametrize("name", lm.interop.__all__)
def test_every_function_is_described_with_its_signature(name):
    function = getattr(lm.interop, name)
    signature = inspect.signature(function)
    bare = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
    wanted = str(signature.replace(parameters=bare, return_annotation=signature.empty))
    assert f"`{name}{wanted}`".replace("'", '"').removeprefix("`") in PAGE.replace("\n", " ")
    for parameter in signature.parameters:
        assert parameter in (inspect.getdoc(function) or "")
