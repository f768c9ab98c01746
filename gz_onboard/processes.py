"""A function over rides, in processes of their own: results in order, and no ride stops another."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import active_children, parent_process
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any, TypeVar

from gz_onboard.errors import InputError
from gz_onboard.options import PICTURE_FORMATS
from gz_onboard.progress import Display, Progress
from gz_onboard.recording.logs import logs_among
from gz_onboard.recording.recording import ride_name
from gz_onboard.reports.results import Failure, distinct_names


@dataclass(frozen=True)
class Task:
    """One ride and what to do with it."""

    path: Path  # its log
    stem: Path  # of the files to be written, without their suffixes
    vehicle: str
    payload: float | None = None  # kg
    plot: bool = True
    picture_format: str = PICTURE_FORMATS[0]
    vehicle_id: str | None = None

    def drawn(self, suffix: str) -> Path | None:
        """The picture to be written, whose name ends in `suffix` and its format; None if none is."""
        return self.output(f"{suffix}.{self.picture_format}") if self.plot else None

    def output(self, suffix: str) -> Path:
        """The file to be written that ends in `suffix`."""
        return self.stem.with_name(self.stem.name + suffix)


TaskT = TypeVar("TaskT", bound=Task)
Answer = TypeVar("Answer")


def tasks_of(arguments: argparse.Namespace, kind: type[TaskT], suffix: str, **options: Any) -> list[TaskT]:
    """A task for each of the logs that a command is given; `options` are those of their `kind` alone.

    suffix: of a file that is written of each. InputError if two logs would be written as one.
    """
    logs = logs_among(arguments.logs)
    names = distinct_names(logs, [ride_name(log).removesuffix(Path(suffix).stem) for log in logs])
    given = arguments.vehicle, arguments.payload, not arguments.no_plot, arguments.picture_format
    options |= {"vehicle_id": getattr(arguments, "vehicle_id", None)}
    return [kind(log, arguments.output / name, *given, **options) for log, name in zip(logs, names, strict=True)]


def over_rides(
    function: Callable[[TaskT], Answer], tasks: Sequence[TaskT], jobs: int | None, progress: Progress = lambda _: None
) -> Iterator[tuple[TaskT, Answer | InputError]]:
    """Each task with what `function` answers, or with the InputError that it raises, in order.

    function: a process must find it at the top of its module. jobs: so many at a time, as many as there are
    processors if None. progress: takes 1 for each ride that is done.
    """
    jobs = min(jobs or len(os.sched_getaffinity(0)), len(tasks))
    if jobs < 2:
        for task in tasks:
            answer = _attempt(function, task)
            progress(1)
            yield task, answer
        return
    with worker_pool(jobs) as pool:
        futures = [pool.submit(_attempt, function, task) for task in tasks]
        for task, future in zip(tasks, futures, strict=True):
            try:
                answer = future.result()
            except BrokenProcessPool:
                answer = InputError(f"{task.path}: the process was killed; is there enough memory? Try --jobs 1")
            progress(1)
            yield task, answer


@contextmanager
def worker_pool(jobs: int, context: BaseContext | None = None) -> Iterator[ProcessPoolExecutor]:
    """A pool of processes that end with the context if it is left by an exception, and with this process.

    context: how they start.
    """
    others = set(active_children())
    with ProcessPoolExecutor(jobs, context, _begin) as pool:
        try:
            yield pool
        except BaseException:  # Ctrl-C too, which reaches this process alone if it is sent to its number
            for process in set(active_children()) - others:
                process.terminate()
            pool.shutdown(cancel_futures=True)
            raise


def collect(
    command: str,
    results: Iterable[tuple[TaskT, Answer | InputError]],
    display: Display,
    text: Callable[[Answer], str] | None,
    warning: Callable[[Answer], str | None] = lambda _: None,
) -> tuple[list[Answer], list[Failure]]:
    """The answers and the failures of `over_rides`; each failure, and `text` and `warning` of each answer, is printed
    at once.
    """
    answers: list[Answer] = []
    failures: list[Failure] = []
    for task, result in results:
        if isinstance(result, InputError):
            failures.append(Failure(str(task.path), str(result)))
            display.print(f"gz-onboard {command}: {result}", sys.stderr)
            continue
        answers.append(result)
        if warned := warning(result):
            display.print(f"gz-onboard {command}: {warned}", sys.stderr)
        if text:
            display.print(text(result), sys.stdout)
    return answers, failures


def _begin() -> None:
    """In each process of the pool: Ctrl-C ends it without a word, which the parent process reports; so does its end."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as a shell has it that started us in the background
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    if parent := parent_process():
        parent.join()
        os._exit(1)


def _attempt(function: Callable[[TaskT], Answer], task: TaskT) -> Answer | InputError:
    try:
        return function(task)
    except InputError as error:
        return error
