"""The finite model as UMB: read by hand from its specification, by umbi, and by Storm."""

import itertools
import json
import tarfile
from fractions import Fraction

import numpy as np
import pytest
from certificate_files import noisy, parsed
from model_checker import COSTS, answer, package
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.results.exports import export_drn, export_umb

PROBLEMS = {
    "steps": steps(),
    "steps, uneven": steps(cost="0.1 + x"),
    "doubling": doubling(),
    "standard map": standard_map(12, 1.0),
    "noise": noisy(),
    "discount": steps(discount=0.9),
    "part of m": noisy(measure={"boxes": [{"x": [0.5, 1.0]}]}),
}


@pytest.fixture(scope="module", params=PROBLEMS)
def lp(request):
    return lm.compile(made(PROBLEMS[request.param]))


def by_hand(path):
    """Labels and states of a file, as ``parsed`` has them of DRN, by the specification alone."""
    with tarfile.open(path) as archive:
        names = archive.getnames()
        files = {name: archive.extractfile(name).read() for name in names}
    assert names[0] == "index.json"
    index = json.loads(files["index.json"])
    counts = index["transition-system"]
    n = counts["#states"]

    def words(name):
        return np.frombuffer(files[name], "<u8").tolist()

    def bits(name):
        assert len(files[name]) == -(-n // 64) * 8
        return np.unpackbits(np.frombuffer(files[name], np.uint8), bitorder="little")[:n]

    strings, at = (
        files["actions/choices/strings.bin"].decode(),
        words("actions/choices/string-mapping.bin"),
    )
    actions = [strings[a:b] for a, b in itertools.pairwise(at)]
    assert len(actions) == counts["#choice-actions"]
    chosen = np.frombuffer(files["actions/choices/values.bin"], "<u4")
    cost = np.frombuffer(files["annotations/rewards/cost/choices/values.bin"], "<f8")
    kind = counts["branch-probability-type"]
    assert kind["type"] == "rational"
    half, data = kind["size"] // 16, files["branch-to-probability.bin"]
    numbers = [data[i : i + half] for i in range(0, len(data), half)]
    shares = [
        Fraction(int.from_bytes(a, "little", signed=True), int.from_bytes(b, "little"))
        for a, b in zip(numbers[::2], numbers[1::2], strict=True)
    ]
    target, branches = words("branch-to-target.bin"), words("choice-to-branches.bin")
    choices = words("state-to-choices.bin")
    assert len(target) == len(shares) == counts["#branches"] == branches[-1]
    assert len(chosen) == len(cost) == counts["#choices"] == choices[-1]
    labels = [[] for _ in range(n)]
    start = bits("state-is-initial.bin")
    assert start.sum() == counts["#initial-states"]
    for name, where in (("init", start), *((name, bits(f"annotations/aps/{name}/states/values.bin"))
                        for name in index["annotations"]["aps"])):  # fmt: skip
        for i in np.flatnonzero(where):
            labels[i].append(name)
    states = [
        [
            (
                actions[chosen[k]],
                Fraction(float(cost[k])),
                dict(zip(target[branches[k] : branches[k + 1]],
                         shares[branches[k] : branches[k + 1]], strict=True)),
            )
            for k in range(choices[i], choices[i + 1])
        ]
        for i in range(n)
    ]  # fmt: skip
    return labels, states


def test_it_is_the_model_that_drn_holds(lp, tmp_path):
    export_drn(lp, tmp_path / "model.drn")
    export_umb(lp, tmp_path / "model.umb")
    assert by_hand(tmp_path / "model.umb") == parsed(tmp_path / "model.drn")


def test_the_same_model_is_the_same_file(lp, tmp_path):
    export_umb(lp, tmp_path / "a")
    export_umb(lp, tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert len((tmp_path / "a").read_bytes()) % tarfile.RECORDSIZE == 0


def test_shares_of_many_digits_are_exact(tmp_path):
    """A total above 64 bits: numerators and denominators take more words."""
    fine = noisy(noise={"w": {"values": [-0.1, 0.0, 0.1], "weights": [0.1, 0.2, 0.7]}})
    lp = lm.compile(made(fine))
    export_umb(lp, tmp_path / "model.umb")
    with tarfile.open(tmp_path / "model.umb") as archive:
        index = json.loads(archive.extractfile("index.json").read())
    total = lp.rows.shares.total
    size = index["transition-system"]["branch-probability-type"]["size"]
    assert size % 128 == 0
    _, states = by_hand(tmp_path / "model.umb")
    assert all(sum(row.values()) == 1 for actions in states for _, _, row in actions)
    assert (size > 128) == (total.bit_length() > 64)


def test_what_it_cannot_hold_is_refused(tmp_path):
    with pytest.raises(lm.BadInput, match=r"gamma: 1.02 .* gamma = 1"):
        export_umb(lm.compile(made(steps(1.02))), tmp_path / "file")
    assert not list(tmp_path.iterdir())


def test_umbi_reads_it(lp, tmp_path):
    umbi = pytest.importorskip("umbi", reason="umbi is not installed")
    export_umb(lp, tmp_path / "model.umb")
    ats = umbi.ats.read(str(tmp_path / "model.umb"))
    labels, states = by_hand(tmp_path / "model.umb")
    assert ats.num_states == len(states)
    assert sorted(ats.initial_states) == [i for i, names in enumerate(labels) if "init" in names]
    ats.validate()
    choices = [choice for actions in states for choice in actions]
    assert ats.num_choices == len(choices)
    assert ats.num_branches == sum(len(row) for _, _, row in choices)
    assert {*ats.choice_action_to_name} >= {name for name, _, _ in choices}
    assert [*ats.reward_annotation_names] == ["cost"]
    if hasattr(ats, "branch_to_probability"):  # of later versions; earlier ones keep one label
        assert {*ats.ap_annotation_names} == {name for names in labels for name in names} - {"init"}
        assert list(ats.branch_to_probability) == [p for *_, row in choices for p in row.values()]
        assert list(ats.branch_to_target) == [j for *_, row in choices for j in row]


def test_storm_reads_it(tmp_path):
    stormpy = package()
    build = getattr(stormpy, "build_model_from_umb", None)
    if build is None:
        pytest.skip("this version of stormpy does not read UMB")
    result = lm.solve(made(standard_map(12, 1.0)))
    export_umb(result.lp, tmp_path / "model.umb")
    found = np.array(answer(build(str(tmp_path / "model.umb")), COSTS))
    np.testing.assert_allclose(found[:-1], result.value[result.lp.cells], rtol=2e-6)
