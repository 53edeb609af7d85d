"""Terminal output of a command: progress on standard error, results on standard output."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.status import Status

from app.watchdog import Watchdog


@dataclass
class Screen:
    """Progress, notes and tables.

    Attributes:
        quiet: Whether to print nothing.
        json: Whether standard output is reserved for the report.
        stage_limit: Time without progress after which a stage is ended, in seconds; 0 for none.
    """

    quiet: bool = False
    json: bool = False
    stage_limit: float = 0.0
    _watchdog: Watchdog | None = None
    _status: Status | None = None
    _title: str = ""
    _progress: Console = field(default_factory=lambda: Console(stderr=True, highlight=False))
    _results: Console = field(default_factory=lambda: Console(highlight=False))

    @contextmanager
    def stage(self, title: str) -> Iterator[None]:
        """Show a spinner while a stage runs, then its wall time.

        Raises:
            StalledError: The stage made no progress for ``stage_limit``.
        """
        with Watchdog(title, self.stage_limit) as self._watchdog, self._shown(title):
            yield
        self._watchdog = None

    @contextmanager
    def _shown(self, title: str) -> Iterator[None]:
        if self.quiet:
            yield
            return
        begin = time.perf_counter()
        with self._progress.status(f"{escape(title)} ...") as status:
            self._status, self._title = status, title
            yield
        self._status = None
        self._progress.print(
            f"[green]✓[/green] {escape(title):<44} [dim]{time.perf_counter() - begin:6.1f} s[/dim]"
        )

    def update(self, detail: str) -> None:
        """Show the progress of the current stage."""
        if self._watchdog is not None:
            self._watchdog.progress()
        if self._status is not None:
            self._status.update(f"{escape(self._title)} ... {escape(detail)}")

    def note(self, text: str) -> None:
        """Print one line of progress."""
        if self._watchdog is not None:
            self._watchdog.progress()
        if not self.quiet:
            self._progress.print(f"  {escape(text)}", style="dim")

    def show(self, renderable: Any) -> None:
        """Print a table or a line of results."""
        if not self.quiet:
            self._results.print(renderable)
