"""Handling of Ctrl-C, SIGTERM and hang-up in each part of a command.

All three do the same. Before a test and in commands without one they interrupt; while a test runs
the first asks for its abort and the second does not wait for the answer; a verdict that is known
they do not change. A hang-up that was ignored when the program began (`nohup`) stays ignored.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

__all__ = [
    "ignore_signals",
    "interrupt_on_signals",
    "keep_signals",
    "leave_interrupt_to_parent",
    "signals_restored",
    "stop_on_signals",
]

Handler = Callable[[int, FrameType | None], Any]
SECOND = 2


@contextmanager
def signals_restored() -> Iterator[None]:
    """Leave the handling of signals as it was before."""
    before = {number: signal.getsignal(number) for number in _numbers()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def interrupt_on_signals() -> threading.Event:
    """Let each signal raise KeyboardInterrupt, as Ctrl-C does anyway; return whether one came.

    One that comes while the compiler calls back is swallowed there, and ends in another error.
    """
    came = threading.Event()

    def handle(_number: int, _frame: FrameType | None) -> None:
        came.set()
        raise KeyboardInterrupt

    _handle(handle)
    return came


def keep_signals() -> threading.Event:
    """Let the first signal set the event and do nothing else; a second raises KeyboardInterrupt.

    Whoever waits for standard output to be read would else wait for ever.
    """
    came = threading.Event()
    _handle(_counting(came))
    return came


def ignore_signals() -> None:
    """Let nothing change the exit code any more; for the end of the process."""
    for number in _numbers():
        signal.signal(number, signal.SIG_IGN)


def leave_interrupt_to_parent() -> None:
    """Ignore Ctrl-C in a worker process: it reaches all of them, and the parent deals with it."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def stop_on_signals(after_s: float | None = None) -> Iterator[threading.Event]:
    """Give an event that the first signal sets, or time; a second signal interrupts at once.

    Only the second one raises KeyboardInterrupt: a third must not get in the way of the last abort
    request that it leads to.
    """
    stop = threading.Event()
    timer = None
    if after_s is not None:
        timer = threading.Timer(after_s, stop.set)
        timer.daemon = True
        timer.start()
    with signals_restored():
        _handle(_counting(stop))
        try:
            yield stop
        finally:
            if timer is not None:
                timer.cancel()


def _counting(first: threading.Event) -> Handler:
    count = 0

    def handle(_number: int, _frame: FrameType | None) -> None:
        nonlocal count
        count += 1
        first.set()
        if count == SECOND:
            raise KeyboardInterrupt

    return handle


def _handle(handler: Handler) -> None:
    for number in _numbers():
        signal.signal(number, handler)


def _numbers() -> list[signal.Signals]:
    """Return the signals that are handled; none in a thread, where Python handles none."""
    if threading.current_thread() is not threading.main_thread():
        return []
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    hang_up = getattr(signal, "SIGHUP", None)
    return [
        number
        for number in numbers
        if number != hang_up or signal.getsignal(number) is not signal.SIG_IGN
    ]
