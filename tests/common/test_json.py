"""What is written by mistake in JSON is told what to write instead."""

import pytest

import lmdsl as lm
from lmdsl.common.files import strict_json


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ('{"low": -pi}', "pi is 3.141592653589793"),
        ('{"high": 2*pi}', "pi is 3.141592653589793"),
        ('{"high": tau}', "tau is 6.283185307179586"),
        ('{"low": 1 / 3}', "digits"),
        ('{"low": .5}', "digits"),
        ('{"low": +1}', "digits"),
        ('{"cost": x + u}', 'formulas in "double quotes"'),
        ('{"periodic": True}', "true and false in small letters"),
        ("{'low': 1}", '"double quotes"'),
        ('{"low": 1} # end', "no comments"),
        ('{"low": 1, // here\n"high": 2}', "no comments"),
    ],
)
def test_what_is_no_json_is_told_what_to_write(text, remedy):
    with pytest.raises(lm.BadInput, match="not JSON: ") as caught:
        strict_json(text.encode())
    assert remedy in str(caught.value).replace("Extra data", "")
    assert "\n" not in str(caught.value)


def test_text_that_is_cut_off_has_no_remedy():
    with pytest.raises(lm.BadInput) as caught:
        strict_json(b'{"low": ')
    assert str(caught.value).endswith("column 9)")
