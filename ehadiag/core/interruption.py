"""Ends work early: the time limit of an identification, Ctrl-C, SIGTERM and hang-up.

These signals do the same, and so does Ctrl-Break on Windows. Before a test and in commands without
one they interrupt; while a test runs the first requests its abort and the second does not wait for
the answer; after the verdict they do not change it. A hang-up that was ignored at the start
(`nohup`) stays ignored.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

COMPUTING_THREAD_NAME = "ehadiag-identification"


def is_computing(timeout_s: float = 0.5) -> bool:
    """Whether a computation that ran out of its time still runs after a short wait."""
    threads = [item for item in threading.enumerate() if item.name == COMPUTING_THREAD_NAME]
    for thread in threads:
        thread.join(timeout_s)
    return any(thread.is_alive() for thread in threads)


SignalHandler = Callable[[int, FrameType | None], Any]
INTERRUPTED_EXIT_CODE = 130
"""Exit code of an interrupted command, as of a shell."""


@contextmanager
def signals_restored() -> Iterator[None]:
    """Leave the handling of signals as it was before."""
    before = {number: signal.getsignal(number) for number in _handled_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def interrupt_on_signals() -> threading.Event:
    """Let each signal raise KeyboardInterrupt; return an event that the first one sets.

    The compiler turns an interruption into a RuntimeError; the event tells it from others.
    """
    arrived = threading.Event()

    def handle(_number: int, _frame: FrameType | None) -> None:
        arrived.set()
        raise KeyboardInterrupt

    _install_handler(handle)
    return arrived


def defer_signals() -> threading.Event:
    """Let the first signal only set the event that is returned; a second interrupts.

    The second one ends a wait for a full standard output.
    """
    arrived = threading.Event()
    _install_handler(_counting_handler(arrived))
    return arrived


def ignore_signals() -> None:
    """Ignore all signals, at the end of the process: they do not change its exit code."""
    for number in _handled_signals():
        signal.signal(number, signal.SIG_IGN)


def ignore_interrupt_in_worker() -> None:
    """Ignore Ctrl-C in a worker process: its parent receives it too, and ends the worker."""
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGBREAK"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), signal.SIG_IGN)


@contextmanager
def stop_on_signals(after_s: float | None = None) -> Iterator[threading.Event]:
    """Give an event that the first signal sets, or a timer; a second signal interrupts at once.

    Only the second one raises KeyboardInterrupt: a third must not interrupt the last request of an
    abort, to which it leads.
    """
    stop = threading.Event()
    timer = None
    if after_s is not None:
        timer = threading.Timer(after_s, stop.set)
        timer.daemon = True
        timer.start()
    with signals_restored():
        _install_handler(_counting_handler(stop))
        try:
            yield stop
        finally:
            if timer is not None:
                timer.cancel()


def _counting_handler(first: threading.Event) -> SignalHandler:
    count = 0

    def handle(_number: int, _frame: FrameType | None) -> None:
        nonlocal count
        count += 1
        first.set()
        # The first one only sets an event.
        if count == 2:
            raise KeyboardInterrupt

    return handle


def _install_handler(handler: SignalHandler) -> None:
    for number in _handled_signals():
        signal.signal(number, handler)


def _handled_signals() -> list[signal.Signals]:
    """Return the signals that are handled; none in a thread, where Python handles none."""
    if threading.current_thread() is not threading.main_thread():
        return []
    names = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")  # SIGBREAK: Ctrl-Break, on Windows only
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    hang_up = getattr(signal, "SIGHUP", None)
    return [
        number
        for number in numbers
        if number != hang_up or signal.getsignal(number) is not signal.SIG_IGN
    ]


SAFE_PATH_VARIABLE = "PYTHONSAFEPATH"


@contextmanager
def children_with_safe_path() -> Iterator[None]:
    """Let no process that is started meanwhile load Python files from the working folder.

    joblib and multiprocessing start workers and resource trackers by `python -m` and `python -c`,
    without `-P`.
    """
    before = os.environ.get(SAFE_PATH_VARIABLE)
    os.environ[SAFE_PATH_VARIABLE] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(SAFE_PATH_VARIABLE, None)
        else:
            os.environ[SAFE_PATH_VARIABLE] = before
