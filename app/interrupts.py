"""SIGINT, SIGTERM and SIGHUP end a command with one line and exit code 128 + signal number (130, 143, 129).

While nothing is at stake, as during imports, the process ends at once: an exception in the middle of an
import is lost in some libraries. Afterwards a signal raises KeyboardInterrupt, so that finished results are
kept.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last: its terminal was closed
_REPEAT_AFTER = 0.02  # [s]
_received: int | None = None
_results_at_stake: Callable[[], bool] = lambda: False  # noqa: E731


def install() -> None:
    """Handle the signals, except those that the parent process ignores."""
    for number in _SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _on_signal)
    sys.unraisablehook = _repeat_lost_interrupt


def raise_if(results_at_stake: Callable[[], bool]) -> None:
    """Raise KeyboardInterrupt for signals that arrive while the condition holds."""
    global _results_at_stake
    _results_at_stake = results_at_stake


def ignore() -> None:
    """Ignore further signals, so that the end of an interrupted command is not interrupted as well."""
    for number in _SIGNALS:
        if signal.getsignal(number) is _on_signal:
            signal.signal(number, signal.SIG_IGN)


def was_interrupted() -> bool:
    """Return whether a signal has arrived."""
    return _received is not None


def exit_code() -> int:
    """Return the exit code of an interrupted process."""
    return 128 + (_received or signal.SIGINT)


def _repeat_lost_interrupt(lost: sys.UnraisableHookArgs) -> None:
    """Repeat a signal whose exception was raised in a finaliser or a callback of a weak reference.

    Python prints and drops exceptions there, and the command would go on.
    """
    if _received is None or not isinstance(lost.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    repeated = threading.Timer(_REPEAT_AFTER, os.kill, (os.getpid(), _received))
    repeated.daemon = True
    repeated.start()


def _on_signal(number: int, frame: FrameType | None) -> None:
    global _received
    _received = number
    if _results_at_stake():
        raise KeyboardInterrupt
    terminal = sys.stderr is not None and sys.stderr.isatty()
    cursor = "\r\x1b[K\x1b[?25h" if terminal else ""  # a spinner hides it
    with contextlib.suppress(OSError):  # the terminal is gone, or nobody reads
        os.write(2, f"{cursor}nodeslam: interrupted\n".encode())
    os._exit(exit_code())
