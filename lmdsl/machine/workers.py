"""Processes of our own that call one Python function many times.

They are spawned, unless the program chose another way (``multiprocessing.set_start_method``).
They end with the block that opened them, with the caller, and as soon as it is interrupted or its
time is up, whatever they are doing then.

Where ``fork`` is the default (Linux before Python 3.14) it cannot be told from a choice: any
library that only asks for the method, or makes a lock, settles on it, as Numba does when it starts
its threads, which do not survive a fork. What can be sent is spawned there.
"""

import contextlib
import multiprocessing
import pickle
import re
import signal
import sys
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing import connection
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from lmdsl.errors import BadInput, LmdslError
from lmdsl.machine.apart import end_with_the_caller

# Seconds between looks at the clock while all workers are busy.
MOMENT = 0.05

ELSE = "or leave processes out"


class Workers:
    """Some processes that each hold a function.

    Parameters
    ----------
    function
        What they call, with one argument.
    count
        How many processes.
    where
        The field that a message names.

    Raises
    ------
    BadInput
        The function cannot reach other processes.
    """

    def __init__(self, function: Callable[[Any], Any], count: int, where: str) -> None:
        self.count, self.where = count, where
        chosen = multiprocessing.get_start_method(allow_none=True)
        context: Any = multiprocessing.get_context(start_method(function, where))
        self._processes: list[Any] = []
        self._idle: list[Any] = []
        for _ in range(count):
            ours, theirs = context.Pipe()
            process = context.Process(target=serve, args=(function, theirs), daemon=True)
            process.start()
            theirs.close()
            self._processes.append(process)
            self._idle.append(ours)
        if chosen is None:  # spawning makes a choice for the whole program
            multiprocessing.set_start_method(None, force=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the processes now."""
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.join()
        for ours in self._idle:
            ours.close()

    def map(self, tasks: Sequence[Any], guard: Callable[[], object] | None = None) -> list[Any]:
        """Return ``[function(task) for task in tasks]``.

        The first error that a worker meets is raised; ``guard`` is called now and then, and may
        raise. After either the processes are of no more use.
        """
        found: list[Any] = [None] * len(tasks)
        waiting, busy, idle = deque(range(len(tasks))), dict[Any, int](), [*self._idle]
        while waiting or busy:
            while waiting and idle:
                k, worker = waiting.popleft(), idle.pop()
                with contextlib.suppress(OSError):  # it ended: seen when its answer is read
                    worker.send(tasks[k])
                busy[worker] = k
            for worker in connection.wait(list(busy), MOMENT):
                found[busy.pop(worker)] = self._answer(worker)
                idle.append(worker)
            if guard is not None:
                guard()
        return found

    def _answer(self, worker: Any) -> Any:
        try:
            error, answer = worker.recv()
        except (EOFError, OSError):
            raise LmdslError(
                f"{self.where}: a process that calls the function ended by itself; call the "
                f"function without processes to see why, {ELSE}"
            ) from None
        if error is not None:
            raise error
        return answer


def serve(function: Callable[[Any], Any], calls: Any) -> None:
    """Do the work of a process: answer calls until there is nobody to answer."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller ends us
    end_with_the_caller()
    with contextlib.suppress(EOFError, OSError):
        while True:
            task = calls.recv()
            reply: tuple[Exception | None, Any]
            try:
                reply = None, function(task)
            except Exception as error:
                reply = _portable(error), None
            calls.send(reply)


def _portable(error: Exception) -> Exception:
    """Return an error that reaches the caller, with the place where it was raised."""
    if not isinstance(error, LmdslError):
        error.add_note("in another process:\n" + "".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        plain = RuntimeError(f"{type(error).__name__}: {error}")
        for note in getattr(error, "__notes__", ()):
            plain.add_note(note)
        return plain
    return error


def start_method(function: Any, where: str) -> str:
    """Return how processes that call a function are started.

    Raises
    ------
    BadInput
        It must be sent to them, and cannot be.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise BadInput(_UNGUARDED, where)
    chosen = multiprocessing.get_start_method(allow_none=True)
    default = multiprocessing.get_all_start_methods()[0]
    if chosen == "fork" != default:
        return chosen
    try:
        refuse_unless_sent(function, where)
    except BadInput:
        if chosen != "fork":
            raise
        return chosen
    return chosen if chosen and chosen != "fork" else "spawn"


def refuse_unless_sent(function: Any, where: str) -> None:
    """Refuse a function that a new process could not receive, in words of what to do.

    Raises
    ------
    BadInput
        It cannot be pickled, or it belongs to a session or a script that no other process can
        import.
    """
    forked = "choose multiprocessing.set_start_method('fork') where the system has it, " + ELSE
    try:
        sent = pickle.dumps(function)
    except Exception as error:
        raise BadInput(
            f"the function cannot be sent to other processes ({error}); define it with def at the "
            f"top of a module, {forked}",
            where,
        ) from None
    main = sys.modules.get("__main__")
    file = getattr(main, "__file__", None)
    if b"__main__" in sent and file is None:
        raise BadInput(
            "the function was defined in an interactive session, which other processes cannot "
            f"import; write it into a module, {forked}",
            where,
        )
    named = getattr(getattr(main, "__spec__", None), "name", "")
    if file is not None and not named.endswith("__main__") and not _guarded(file):
        raise BadInput(_UNGUARDED, where)


_UNGUARDED = (
    "every process that is started imports the program anew, and would run all of it: put what "
    f"runs behind if __name__ == '__main__':, {ELSE}"
)


def _guarded(file: str) -> bool:
    """Return whether a program tells being run from being imported, as far as can be seen."""
    try:
        text = Path(file).read_bytes()
    except OSError:
        return True
    return re.search(rb"__name__\s*==|==\s*__name__", text) is not None or not file.endswith(".py")
