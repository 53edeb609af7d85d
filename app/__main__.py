"""``python -m app``, the same as the console script ``nodeslam``."""

from __future__ import annotations

import io
import os
import sys
import warnings
from typing import TYPE_CHECKING

# Before anything loads numpy: its thread pool and torch's on the same cores slow both several times.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from app import interrupts

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


def main() -> None:
    interrupts.install()
    _complete_standard_streams()
    code = run(sys.argv[1:])
    try:
        sys.stdout.flush()
    except OSError:  # the reader of a pipe has ended; at exit, Python would complain
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run a command; its modules are imported only when the signals are handled."""
    from app import cli
    from app.caches import use_writable_caches

    use_writable_caches()
    if not sys.warnoptions:  # of libraries, in source lines; -W or PYTHONWARNINGS show them
        warnings.simplefilter("ignore")
    return cli.run(arguments)


def _complete_standard_streams() -> None:
    """Replace closed streams, whose descriptors the next opened files would get; print in any locale."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            handle = os.open(os.devnull, os.O_RDWR)
            if handle != number:
                os.dup2(handle, number)
                os.close(handle)
            mode = "w" if number else "r"
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # without Unicode, m³ is printed as m\\xb3
    sys.stderr = io.TextIOWrapper(
        io.BufferedWriter(_Progress(2, "w", closefd=False)),
        encoding=sys.stderr.encoding, errors="backslashreplace", write_through=True, line_buffering=True,
    )  # fmt: skip


class _Progress(io.FileIO):
    """Standard error; a run goes on when its progress cannot be written, such as to a full disk."""

    def write(self, content: ReadableBuffer) -> int:
        try:
            return super().write(content)
        except OSError:
            return memoryview(content).nbytes


if __name__ == "__main__":
    main()
