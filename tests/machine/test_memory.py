"""How much memory there is: every limit that an operating system or a scheduler may set."""

import pytest

from lmdsl.errors import BadInput
from lmdsl.machine import memory

GB = 2**30
NOTHING = {}


def machine(tmp_path, files, free=100 * GB):
    """Make a fake ``/proc`` and ``/sys``: path to text."""
    files = {
        "proc/meminfo": f"MemTotal: 1 kB\nMemAvailable: {free // 1024} kB\n",
        "proc/self/status": f"Name:\tpython\nVmSize:\t0 kB\nVmRSS:\t{GB // 1024} kB\n",
        **files,
    }
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    return tmp_path


TWO = "29 1 0:26 / /sys/fs/cgroup rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n"
ONE = (
    "31 1 0:28 / /sys/fs/cgroup rw - tmpfs tmpfs rw,mode=755\n"
    "32 31 0:29 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu,cpuacct\n"
    "35 31 0:32 / /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory\n"
    "41 31 0:38 / /sys/fs/cgroup/unified rw - cgroup2 cgroup2 rw\n"
)


def two(path, **numbers):
    folder = "sys/fs/cgroup" + path
    return {f"{folder}/memory.{name}": f"{value}\n" for name, value in numbers.items()}


def one(path, limit, used, stat=""):
    folder = "sys/fs/cgroup/memory" + path
    return {
        f"{folder}/memory.limit_in_bytes": f"{limit}\n",
        f"{folder}/memory.usage_in_bytes": f"{used}\n",
        f"{folder}/memory.stat": stat,
    }


SLICE = "/user.slice/user-1.slice/run.scope"
GROUPS = [
    ("none", {}, 100 * GB, "free memory"),
    ("own group", {
        "proc/self/mountinfo": TWO, "proc/self/cgroup": "0::/job\n",
        **two("/job", max=5 * GB, current=2 * GB),
    }, 3 * GB, "control group /job"),
    ("a slice above counts", {
        "proc/self/mountinfo": TWO, "proc/self/cgroup": f"0::{SLICE}\n",
        **two(SLICE, max="max", current=GB),
        **two("/user.slice/user-1.slice", max=9 * GB, current=2 * GB),
        **two("/user.slice", max=8 * GB, current=6 * GB),
    }, 2 * GB, "control group /user.slice"),
    ("a soft limit slows down", {
        "proc/self/mountinfo": TWO, "proc/self/cgroup": "0::/job\n",
        **two("/job", max=50 * GB, high=4 * GB, current=GB),
    }, 3 * GB, "control group /job"),
    ("files that were read are given back", {
        "proc/self/mountinfo": TWO, "proc/self/cgroup": "0::/job\n",
        **two("/job", max=5 * GB, current=4 * GB, stat=f"anon 1\ninactive_file {3 * GB}"),
    }, 4 * GB, "control group /job"),
    ("a container is its own top", {
        "proc/self/mountinfo": TWO, "proc/self/cgroup": "0::/\n",
        **two("", max=6 * GB, current=GB),
    }, 5 * GB, "control group /"),
    ("a container is told a path of the host", {
        "proc/self/mountinfo": TWO.replace(" / ", " /docker/abc "),
        "proc/self/cgroup": "0::/docker/abc/inner\n",
        **two("/inner", max=6 * GB, current=2 * GB), **two("", max=9 * GB, current=2 * GB),
    }, 4 * GB, "control group /inner"),
    ("a path that is not there", {
        "proc/self/mountinfo": TWO, "proc/self/cgroup": "0::/docker/abc\n",
        **two("", max=6 * GB, current=GB),
    }, 5 * GB, "control group /"),
    ("a path above the top", {
        "proc/self/mountinfo": TWO, "proc/self/cgroup": "0::/../../elsewhere\n",
        **two("", max=6 * GB, current=GB),
        "sys/memory.max": "1\n",
    }, 5 * GB, "control group /"),
    ("version 1", {
        "proc/self/mountinfo": ONE,
        "proc/self/cgroup": "9:name=systemd:/x\n4:memory:/job\n1:cpu:/cpus\n0::/\n",
        **one("/job", 7 * GB, 4 * GB), **one("", 9223372036854771712, 50 * GB),
    }, 3 * GB, "control group /job"),
    ("version 1, the group above", {
        "proc/self/mountinfo": ONE, "proc/self/cgroup": "4:cpuset,memory:/a/b\n",
        **one("/a/b", 7 * GB, GB), **one("/a", 4 * GB, 2 * GB, f"total_inactive_file {GB}"),
    }, 3 * GB, "control group /a"),
    ("version 1, a group above that cannot be seen", {
        "proc/self/mountinfo": ONE, "proc/self/cgroup": "4:memory:/elsewhere/a\n",
        **one("", 9223372036854771712, GB, f"hierarchical_memory_limit {3 * GB}\n"),
    }, 2 * GB, "control group /"),
    ("both versions at once", {
        "proc/self/mountinfo": ONE, "proc/self/cgroup": "4:memory:/a\n0::/b\n",
        **one("/a", 7 * GB, GB), **two("/unified/b", max=2 * GB, current=GB),
    }, GB, "control group /b"),
    ("full", {
        "proc/self/mountinfo": TWO, "proc/self/cgroup": "0::/job\n",
        **two("/job", max=GB, current=2 * GB),
    }, 0, "control group /job"),
    ("nonsense is no limit", {
        "proc/self/mountinfo": "what\n - \n- -\n1 2 - cgroup2\n" + TWO,
        "proc/self/cgroup": "\n:\n0::/job\n", **two("/job", max="what", current=""),
    }, 100 * GB, "free memory"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("files", "left", "limit"), [g[1:] for g in GROUPS], ids=[g[0] for g in GROUPS]
)
def test_control_groups_and_all_around_them_count(tmp_path, files, left, limit):
    assert memory.available(machine(tmp_path, files), NOTHING) == (left, limit)


SLURM = [
    ({"SLURM_MEM_PER_NODE": "4096"}, 3 * GB, "SLURM_MEM_PER_NODE"),
    ({"SLURM_MEM_PER_NODE": "4G"}, 3 * GB, "SLURM_MEM_PER_NODE"),
    ({"SLURM_MEM_PER_NODE": "0"}, 100 * GB, "free memory"),
    ({"SLURM_MEM_PER_NODE": "plenty"}, 100 * GB, "free memory"),
    ({"SLURM_MEM_PER_CPU": "2048", "SLURM_CPUS_ON_NODE": "4"}, 7 * GB, "SLURM_MEM_PER_CPU"),
    ({"SLURM_MEM_PER_CPU": "2G", "SLURM_JOB_CPUS_PER_NODE": "3(x2)"}, 5 * GB, "SLURM_MEM_PER_CPU"),
    ({"SLURM_MEM_PER_CPU": "2048"}, GB, "SLURM_MEM_PER_CPU"),
    ({"SLURM_MEM_PER_GPU": "3072", "SLURM_GPUS_ON_NODE": "2"}, 5 * GB, "SLURM_MEM_PER_GPU"),
    ({"SLURM_MEM_PER_NODE": "512"}, 0, "SLURM_MEM_PER_NODE"),
]  # fmt: skip


@pytest.mark.parametrize(("environ", "left", "limit"), SLURM)
def test_a_slurm_job_counts(tmp_path, environ, left, limit):
    assert memory.available(machine(tmp_path, {}), environ) == (left, limit)


@pytest.mark.parametrize(("name", "word"), [("RLIMIT_AS", "-v"), ("RLIMIT_DATA", "-d")])
def test_ulimit_counts(tmp_path, monkeypatch, name, word):
    import resource

    limits = {getattr(resource, name): 10 * GB}
    unlimited = resource.RLIM_INFINITY
    monkeypatch.setattr(resource, "getrlimit", lambda which: (limits.get(which, unlimited),) * 2)
    status = f"VmSize:\t{4 * GB // 1024} kB\nVmData:\t{4 * GB // 1024} kB\n"
    root = machine(tmp_path, {"proc/self/status": status})
    assert memory.available(root, NOTHING) == (6 * GB, f"ulimit {word}")


def test_where_nothing_is_known_something_is_assumed(tmp_path):
    assert 2**28 < memory.available(tmp_path, NOTHING).bytes < 2**50


def test_a_refusal_says_what_limits(monkeypatch):
    free = memory.Memory(3 * 10**9, "control group /job")
    monkeypatch.setattr(memory, "available", lambda: free)
    memory.require(3 * 10**9, "it fits")
    with pytest.raises(
        BadInput, match=r"about 4 GB .*\(rows\).* 3 GB .*\(control group /job\); use"
    ):
        memory.require(4 * 10**9, "rows")
