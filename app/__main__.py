"""``python -m app``, the same as the console script ``nodeslam``."""

import os
import sys

# Before anything loads numpy: its thread pool and torch's on the same cores slow both several times.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from app import interrupts


def main() -> None:
    interrupts.install()
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
    return cli.run(arguments)


if __name__ == "__main__":
    main()
