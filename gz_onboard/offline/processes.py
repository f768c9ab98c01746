"""A function over rides, in processes of their own: results in order, progress of all, and no ride stops another."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import Value
from pathlib import Path
from typing import Any, Protocol, TypeVar

from gz_onboard.errors import InputError

MOST_JOBS = 256
"""Processes: each takes some 100 MB and does nothing else than a processor's work."""
Progress = Callable[[float], None]
"""Is told how much work was done since the last time, in any unit."""
Say = Callable[[str, Any], None]
"""Prints a text to a stream."""


class OfRide(Protocol):
    """What is to be done with one ride."""

    @property
    def path(self) -> Path:
        """Its log."""


Task = TypeVar("Task", bound=OfRide)
Answer = TypeVar("Answer")


def over_rides(
    function: Callable[[Task, Progress], Answer],
    tasks: Sequence[Task],
    jobs: int | None,
    progress: Progress = lambda _: None,
    option: str = "--jobs",
) -> Iterator[tuple[Task, Answer | InputError]]:
    """Each task with what `function` answers, or with the InputError that it raises, in order.

    function: of a task and of what it tells its work, which reaches `progress`; to be found at the top of its module.
    jobs: so many at a time, as many as there are processors if None; InputError beyond 1 to `MOST_JOBS`. option: of
    the command line, that sets it.
    """
    if jobs is not None and not 1 <= jobs <= MOST_JOBS:
        raise InputError(f"{option} {jobs}: must be 1 to {MOST_JOBS} processes")
    jobs = min(jobs or len(os.sched_getaffinity(0)), len(tasks))
    if jobs < 2:
        for task in tasks:
            yield task, _attempt(function, task, progress)
        return
    done = Value("d")
    with ProcessPoolExecutor(jobs, initializer=_begin, initargs=(done,)) as pool:
        futures = [pool.submit(_attempt, function, task) for task in tasks]
        told = 0.0
        for task, future in zip(tasks, futures, strict=True):
            while not future.done():
                wait([future], 0.2)
                now = float(done.value)
                progress(now - told)
                told = now
            try:
                answer = future.result()
            except BrokenProcessPool:
                killed = f"{task.path}: the process was killed; is there enough memory? Try {option} 1"
                answer = InputError(killed)
            yield task, answer


_done: Any = None  # work done by all processes of the pool


def _begin(done: Any) -> None:
    """In each process of the pool: Ctrl-C ends it without a word; the parent process tells."""
    global _done  # noqa: PLW0603 - the only way into a process of the pool
    _done = done
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as a shell has it that started us in the background
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _count(work: float) -> None:
    with _done.get_lock():
        _done.value += work


def _attempt(
    function: Callable[[Task, Progress], Answer], task: Task, progress: Progress = _count
) -> Answer | InputError:
    try:
        return function(task, progress)
    except InputError as error:
        return error


@contextlib.contextmanager
def progress_bar(total: Callable[[], float | None], **form: Any) -> Iterator[tuple[Progress, Say]]:
    """(what counts the work, what prints a text); a bar, as tqdm's `form` has it, where standard error is a terminal.

    total: all the work, None if unknown; asked for the bar only.
    """
    if not sys.stderr.isatty():
        yield lambda _: None, lambda text, stream: print(text, file=stream, flush=True)
        return
    from tqdm import tqdm

    with tqdm(total=total(), file=sys.stderr, leave=False, mininterval=0.2, **form) as bar:
        yield bar.update, lambda text, stream: tqdm.write(text, file=stream)
