"""Show progress: a bar on standard error if that is a terminal, nothing otherwise."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)


@contextmanager
def progress(
    what: str, total: Callable[[], int], *, shares_screen: bool = False
) -> Iterator[Callable[[int], None]]:
    """Yield a function that takes the finished amount of `total()`.

    `shares_screen`: the work writes to standard output. If standard output is a terminal, there is no bar.
    """
    console = Console(stderr=True)
    if not console.is_terminal or (shares_screen and sys.stdout.isatty()):
        yield lambda _done: None
        return
    columns = (SpinnerColumn(), TextColumn(what), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total() or None)
        yield lambda done: bar.update(task, completed=done)
