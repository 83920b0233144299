"""Directories checked over ranks beside one process: the same outcome, sentence by sentence."""

import json
import re
from types import SimpleNamespace

import lmdsl as lm
from lmdsl import distributed
from lmdsl.ranks.threaded import as_threads
from lmdsl.results.directory import reading

ABOUT = re.compile(r"\b(\d+\.\d*(e[+-]?\d+)?|\d+e[+-]?\d+)\b")  # which ranks sum in another order


def over(count, path, **options):
    """What so many ranks find, all the same."""
    every = as_threads(count, lambda ranks: distributed.verify(path, ranks=ranks, **options))
    for found in every[1:]:
        assert found.to_dict() == every[0].to_dict()
    return every[0]


def said(sentences):
    """Sentences without the numbers that are rounded."""
    return [ABOUT.sub("#", sentence) for sentence in sentences]


def outcome(work):
    """What work returns, or what is said where its input is bad."""
    try:
        return work(), None
    except lm.BadInput as error:
        return None, str(error)


def require_same(path, counts=(1, 2, 3, 4)):
    """Require of so many ranks what one process finds, or raises; return that."""
    one, error = outcome(lambda: lm.verify(path))
    if error is not None:
        assert [outcome(lambda c=count: over(c, path))[1] for count in counts] == [error] * len(
            counts
        )
        return SimpleNamespace(holds=False, reasons=[error])
    for count in counts:
        found = over(count, path)
        assert (found.holds, found.status, found.same_model, found.scope) == (
            one.holds, one.status, one.same_model, one.scope)  # fmt: skip
        assert found.certificate.claims == one.certificate.claims
        assert found.certificate.refusal == one.certificate.refusal
        assert said(found.reasons) == said(one.reasons)
        assert found.notes == one.notes
    return one


def saved(problem, out, count=2, **options):
    """Write the answer of so many ranks."""
    as_threads(count, lambda r: distributed.solve(problem, out=out, ranks=r, **options))
    return out


def say(folder, **changed):
    """Let a certificate say something else."""
    place = folder / "certificate.json"
    place.write_bytes(reading.text({**json.loads(place.read_text()), **changed}))
