"""What a launcher says of this process by its environment: of how many ranks it is which one.

A process that is alone must never be taken for one of many, nor many for one. So a variable counts
only where the launcher sets it for the ranks that it starts: ``sbatch`` and ``salloc``, say, set
``SLURM_NTASKS`` for a script that is one process; ``srun`` sets the number of tasks of its step.
What a rank starts inherits the variables and is no rank: MPICH's launcher talks by a file
descriptor, which is closed there.
"""

import os
from typing import NamedTuple

# By launcher: the number of ranks, which of them this one is, and what must be set beside.
LAUNCHED = (
    ("PMI_SIZE", "PMI_RANK", ()),  # MPICH, Intel MPI, MVAPICH, Cray
    ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK", ()),  # Open MPI
    ("PMIX_SIZE", "PMIX_RANK", ()),
    ("SLURM_STEP_NUM_TASKS", "SLURM_PROCID", ("SLURM_STEP_ID",)),  # srun
    ("FLUX_JOB_SIZE", "FLUX_TASK_RANK", ()),  # flux run
)
# The same of one machine: there may be more elsewhere.
LOCAL = (
    ("MPI_LOCALNRANKS", "MPI_LOCALRANKID", ()),  # MPICH
    ("PALS_LOCAL_SIZE", "PALS_RANKID", ()),  # HPE
)
NO_STEP = (
    2**32 - 16
)  # from which on a number of Slurm stands for a step that is a shell or a script


class Launched(NamedTuple):
    """What a launcher says; of a process that none started: 1 rank, this one."""

    ranks: int = 1  # how many
    rank: int = 0  # which one this is
    exact: bool = True  # whether there are no others, on other machines


def launched() -> Launched:
    """Return what the launcher says of this process."""
    if _closed(_number("PMI_FD")):
        return Launched()
    for table, exact in ((LAUNCHED, True), (LOCAL, False)):
        for size, rank, beside in table:
            count, which = _number(size), _number(rank)
            known = all((found := _number(name)) is not None and found < NO_STEP for name in beside)
            needed = which is not None or size.startswith(("PMI_", "OMPI_", "PMIX_", "MPI_"))
            if count and known and needed:
                return Launched(count, which or 0, exact)
    return Launched()


def _closed(descriptor: int | None) -> bool:
    try:
        return descriptor is not None and os.fstat(descriptor) is None
    except OSError:
        return True


def _number(name: str) -> int | None:
    text = os.environ.get(name, "")
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 12 else None
