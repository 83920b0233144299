"""The verbs mean the same alone, in threads and under MPI, and errors end all ranks."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest
from launching import launch, needs_mpi, returned
from rank_programs import PROGRAMS

from lmdsl.errors import BadInput, MissingDependency
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.ranks import launchers, mpi
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import Alone, RankError, Traffic
from lmdsl.ranks.watching import Watched

COUNTS = [1, 2, 3, 4, 7]


def expected(count):
    """What ``verbs`` returns, by its definition alone."""
    for me in range(count):
        yield {
            "came": {
                str(k): list(range(10 * k + me, 10 * k + me + k + 1))
                for k in range(count)
                if (k + me) % 3
            },
            "collected": [{"rank": k} for k in range(count)],
            "gathered": None if me else [float(k) for k in range(count) for _ in range(k + 1)],
            "listed": None if me else list(range(count)),
            "scattered": [me] * (me + 1),
            "shared": "of rank 0",
            "any": count > 1,
            "all": count <= 3,
            "agreed": me * me,
        }


@pytest.mark.parametrize("count", COUNTS)
def test_every_verb_in_threads(count):
    assert as_threads(count, PROGRAMS["verbs"]) == list(expected(count))


def test_every_verb_alone():
    assert [PROGRAMS["verbs"](Alone())] == list(expected(1))


@needs_mpi
@pytest.mark.parametrize("count", [2, 4])
def test_every_verb_under_mpi(count):
    assert returned(count, "verbs") == list(expected(count))


def test_sums_depend_on_the_parts_alone():
    """Folded from the left as one process does, to the bit; in another order they are others."""
    whole = PROGRAMS["sums"](Alone())
    assert all(as_threads(n, PROGRAMS["sums"]) == [whole] * n for n in COUNTS)
    parts = [1e16, 1.0, -1e16, 3.0, 1e-3, 7e15, -1.0, 0.1, -7e15, 0.2, 0.3, 1.0]
    assert whole != (sum(parts[:6]) + sum(parts[6:])).hex()  # what each rank would sum alone


@needs_mpi
def test_sums_under_mpi():
    assert returned(2, "sums") == [PROGRAMS["sums"](Alone())] * 2


@pytest.mark.parametrize("count", COUNTS)
def test_an_error_within_agreed_is_that_of_the_lowest_rank_everywhere(count):
    rank = count // 2
    words = ["BadInput", f"stage_cost: the cost of rank {rank} is nan", "stage_cost", True]
    assert as_threads(count, PROGRAMS["agreed_error"]) == [words] * count


@needs_mpi
def test_an_agreed_error_under_mpi():
    words = ["BadInput", "stage_cost: the cost of rank 1 is nan", "stage_cost", True]
    assert returned(2, "agreed_error") == [words] * 2


@pytest.mark.parametrize("count", COUNTS)
def test_an_error_on_one_rank_ends_all(count):
    with pytest.raises(ValueError, match="met by the last rank"):
        as_threads(count, PROGRAMS["lonely_error"])
    with pytest.raises(KeyboardInterrupt):
        as_threads(count, PROGRAMS["lonely_memory"])


@needs_mpi
@pytest.mark.parametrize(("program", "status"), [("lonely_error", 4), ("lonely_memory", 130)])
def test_an_error_on_one_process_ends_all(program, status):
    began = time.monotonic()
    done = launch(2, program)
    assert done.returncode == status
    assert done.stdout == ""
    assert "rank 1 of 2: " in done.stderr
    assert "Traceback" not in done.stderr
    assert time.monotonic() - began < 30  # not for ever: launch ends it after 60


@pytest.mark.parametrize("count", [2, 3])
def test_long_work_ends_when_another_rank_fails(count):
    words = ["met by rank 0", f"met by rank {count - 1}"]
    assert as_threads(count, PROGRAMS["early"]) == [(words, True)] * count


@needs_mpi
def test_long_work_of_processes_ends_when_another_one_fails():
    words = ["met by rank 0", "met by rank 1"]
    assert returned(2, "early") == [[words, True]] * 2


def test_a_watched_deadline_passes_when_its_own_does():
    watched = Watched(Alone(), Deadline(0.01))
    assert 0 < watched.left <= 0.01
    time.sleep(0.02)
    assert watched()
    with pytest.raises(TimeLimitReached, match="testing"):
        watched.raise_if_over("testing")
    watched = Watched(Alone(), Deadline())
    assert not watched()
    watched.cancel()
    assert watched()


@needs_mpi
def test_a_process_that_is_killed_ends_all():
    began = time.monotonic()
    done = launch(3, "killed")
    assert done.returncode != 0
    assert "[1, 1" not in done.stdout  # what the launcher itself says is there
    assert time.monotonic() - began < 30


@pytest.mark.parametrize("count", COUNTS)
def test_a_full_disk_on_one_rank_is_everybodys(count):
    assert as_threads(count, PROGRAMS["full_disk"]) == [[True, "V.npy"]] * count


@needs_mpi
def test_a_full_disk_under_mpi():
    assert returned(2, "full_disk") == [[True, "V.npy"]] * 2


@pytest.mark.parametrize("count", COUNTS)
def test_all_stop_in_the_same_round(count):
    assert as_threads(count, PROGRAMS["deadline"]) == [True] * count


@needs_mpi
def test_all_processes_stop_in_the_same_round():
    assert returned(2, "deadline") == [True] * 2


def test_ranks_out_of_step_are_told_apart():
    for count in (2, 3):
        with pytest.raises(RankError, match="number"):
            as_threads(count, PROGRAMS["out_of_step"])


@needs_mpi
def test_processes_out_of_step_are_told_apart():
    done = launch(2, "out_of_step")
    assert done.returncode == 4
    assert "verb number" in done.stderr


def test_other_verbs_are_told_apart():
    def program(ranks):
        return ranks.collect(1) if ranks.rank else ranks.exchange({})

    with pytest.raises(RankError, match=r"says '(collect|exchange)'"):
        as_threads(2, program)


@pytest.mark.parametrize("size", [1, 3])
def test_a_parcel_of_another_size_is_refused(size):
    def program(ranks):
        other = 1 - ranks.rank
        return ranks.exchange({other: np.zeros(size)}, {other: 2})

    with pytest.raises(RankError, match=rf"expects 2 numbers of rank \d, and got {size}"):
        as_threads(2, program)


def test_a_parcel_that_was_not_expected_or_does_not_come_is_refused():
    def unexpected(ranks):
        return ranks.exchange({0: np.zeros(2)} if ranks.rank else {}, {})

    def missing(ranks):
        return ranks.exchange({}, {0: 2} if ranks.rank else {})

    for program in (unexpected, missing):
        with pytest.raises(RankError, match="expects"):
            as_threads(2, program)
    with pytest.raises(RankError, match="is alone"):
        Alone().exchange({}, {1: 3})


def test_numbers_of_another_kind_and_strangers_are_refused():
    with pytest.raises(RankError, match="not float64"):
        as_threads(2, lambda ranks: ranks.exchange({1 - ranks.rank: np.zeros(1, np.int8)}, {}))
    with pytest.raises(RankError, match="sends to rank 2 of 2"):
        as_threads(2, lambda ranks: ranks.exchange({2: np.zeros(1)}))
    with pytest.raises(RankError, match="sends to rank 1 of 1"):
        Alone().exchange({1: np.zeros(1)})


def test_a_parcel_is_what_it_was_when_it_was_sent():
    def program(ranks):
        own = np.full(3, float(ranks.rank))
        came = ranks.exchange({1 - ranks.rank: own})
        own[:] = 9.0
        ranks.any(True)
        return came[1 - ranks.rank].tolist()

    assert as_threads(2, program) == [[1.0] * 3, [0.0] * 3]


def test_ranks_that_see_different_things_are_refused():
    with pytest.raises(RankError, match="different versions: rank 1 has 1, rank 0 0"):
        as_threads(3, lambda ranks: ranks.alike(min(ranks.rank, 1), "versions"))
    as_threads(3, lambda ranks: ranks.alike(["the same"], "files"))


def test_traffic_is_counted():
    def program(ranks):
        ranks.exchange({1 - ranks.rank: np.zeros(4), ranks.rank: np.zeros(9)})
        ranks.any(True)
        return ranks.traffic

    assert as_threads(2, program) == [Traffic(calls=2, sent=32)] * 2


def alone(monkeypatch, **variables):
    for names in (*launchers.LAUNCHED, *launchers.LOCAL):
        for name in (*names[:2], *names[2]):
            monkeypatch.delenv(name, raising=False)
    monkeypatch.delenv("PMI_FD", raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)


@pytest.mark.parametrize(
    ("variables", "found"),
    [
        ({}, (1, 0, True)),
        ({"PMI_SIZE": "3", "PMI_RANK": "2", "MPI_LOCALNRANKS": "2"}, (3, 2, True)),
        ({"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_RANK": "1"}, (2, 1, True)),
        ({"MPI_LOCALNRANKS": "2"}, (2, 0, False)),
        ({"PALS_LOCAL_SIZE": "4", "PALS_RANKID": "9"}, (4, 9, False)),
        ({"FLUX_JOB_SIZE": "4", "FLUX_TASK_RANK": "3"}, (4, 3, True)),
        # of an instance of Flux, whose first program is one process
        ({"FLUX_JOB_SIZE": "4"}, (1, 0, True)),
        ({"SLURM_STEP_NUM_TASKS": "2", "SLURM_PROCID": "1", "SLURM_STEP_ID": "0"}, (2, 1, True)),
        # sbatch -n 8, a script of it, salloc -n 8, and an interactive step: one process each
        ({"SLURM_NTASKS": "8"}, (1, 0, True)),
        ({"SLURM_NTASKS": "8", "SLURM_PROCID": "0"}, (1, 0, True)),
        ({"SLURM_STEP_NUM_TASKS": "8", "SLURM_PROCID": "0"}, (1, 0, True)),
        ({"SLURM_STEP_NUM_TASKS": "8", "SLURM_PROCID": "0", "SLURM_STEP_ID": "4294967290"},
         (1, 0, True)),
        ({"PMI_SIZE": "many"}, (1, 0, True)),
        # started by a rank; and a rank
        ({"PMI_SIZE": "3", "PMI_RANK": "2", "PMI_FD": "99999"}, (1, 0, True)),
        ({"PMI_SIZE": "3", "PMI_RANK": "2", "PMI_FD": "0"}, (3, 2, True)),
    ],
)  # fmt: skip
def test_what_launchers_say(monkeypatch, variables, found):
    alone(monkeypatch, **variables)
    assert launchers.launched() == found


def test_a_launcher_without_mpi4py_is_refused(monkeypatch):
    alone(monkeypatch)
    assert isinstance(mpi.at_hand(), Alone)
    monkeypatch.setenv("PMI_SIZE", "1")
    assert isinstance(mpi.at_hand(), Alone)
    monkeypatch.setenv("PMI_SIZE", "3")
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    with pytest.raises(MissingDependency, match="started 3 ranks, and mpi4py cannot be imported"):
        mpi.at_hand()


@needs_mpi
def test_a_launcher_of_another_mpi_is_refused():
    code = "from lmdsl.ranks.mpi import at_hand; at_hand()"
    env = {**os.environ, "OMPI_COMM_WORLD_SIZE": "2"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert "the launcher started 2 ranks, and MPI sees 1" in done.stderr


def test_agreed_errors_go_to_the_caller():
    assert issubclass(MissingDependency, BadInput)  # exit status 2
