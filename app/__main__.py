"""``python -m app``, the same as the console script ``nodeslam``."""

import os
import sys

# Before anything loads numpy: its thread pool and torch's on the same cores slow both several times.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from app.cli import run


def main() -> None:
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
