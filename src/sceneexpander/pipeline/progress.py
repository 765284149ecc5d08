"""Progress of long work: a live bar with step, loss and time left in a terminal, nothing elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


class Bar:
    """One running bar. Does nothing without a terminal."""

    def __init__(self, progress: Progress | None, task: TaskID | None) -> None:
        self._progress = progress
        self._task = task

    def update(self, step: int, loss: float | None = None) -> None:
        """Show that ``step`` steps are done, with the last loss."""
        if self._progress is not None and self._task is not None:
            shown = "" if loss is None else f"loss {loss:.4g}"
            self._progress.update(self._task, completed=step, loss=shown)


@contextmanager
def progress_bar(title: str, steps: int) -> Iterator[Bar]:
    """A bar for ``steps`` steps on stderr; silent if stderr is not a terminal or there is nothing to do."""
    console = Console(stderr=True)
    if not console.is_terminal or steps == 0:
        yield Bar(None, None)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[loss]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        yield Bar(progress, progress.add_task(title, total=steps, loss=""))
