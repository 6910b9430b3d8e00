"""Show the status again and again: in place on a terminal, one after the other in a pipe."""

import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Annotated, NamedTuple

import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from appliance.audit.log.record_format import rfc3339
from appliance.base import clock
from appliance.base.timestamps import local_text
from appliance.cli.connection.admin_client import AccessDeniedError, NotRunningError
from appliance.cli.durations import bounded_span
from appliance.cli.output import say_json, usage_error
from rosmop.tool.terminal import printable

Watch = Annotated[
    bool, typer.Option("--watch", help="Show it again and again until Ctrl-C; on a terminal, in place")
]
_SECONDS = 2.0
_INTERRUPTED, _AWAY = 130, 2
_MAX_DENIED = 3  # answers in a row: a restarted api knows no token for a moment


def seconds_between(every: str | None, verb: str, *, watch: bool) -> float:
    """Return the seconds of --every; exit with status 2 if it has no use or is out of bounds."""
    if every is None:
        return _SECONDS
    if not watch:
        raise usage_error("--every needs --watch", verb)
    return bounded_span("--every", every, "1s", "1h", verb)


class StatusView(NamedTuple):
    """A status: the exit status, its form on a terminal, and the JSON object."""

    exit_status: int
    screen: RenderableType
    fields: Mapping[str, object]


Look = Callable[[], StatusView]


class _Looks:
    """The views of the status. While the appliance does not answer, a view shows the reason, and for how long."""

    def __init__(self, look: Look) -> None:
        self._look = look
        self._away_since: int | None = None
        self._denied = -math.inf  # the first denial is final
        self.exit_status = _INTERRUPTED

    def next(self) -> StatusView:
        try:
            view = self._look()
        except AccessDeniedError as error:
            self._denied += 1
            if not 0 < self._denied < _MAX_DENIED:
                raise
            view = self._away(error)
        except NotRunningError as error:
            view = self._away(error)
        else:
            self._away_since, self._denied = None, 0
        self.exit_status = view.exit_status
        return view

    def _away(self, error: NotRunningError) -> StatusView:
        if self._away_since is None:
            self._away_since = clock.wall_ns()
        since = rfc3339(self._away_since)
        text = f"not running since {_time_of_day(self._away_since)}: {printable(str(error))}"
        return StatusView(
            _AWAY, Text(text, style="bold red"), {"not_running_since": since, "error": str(error)}
        )


def _time_of_day(nanoseconds: int) -> str:
    return local_text(nanoseconds, digits=0).partition("T")[2]


def watch_status(look: Look, seconds: float, *, as_json: bool) -> int:
    """Show the status until Ctrl-C; return the exit status of the last one. Raises `AccessDeniedError`."""
    looks, console = _Looks(look), Console(highlight=False)
    try:
        if as_json or not console.is_terminal or console.is_dumb_terminal:
            _print_each(looks, seconds, console, as_json=as_json)
        else:
            _redraw(looks, seconds, console)
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:  # the reader (head, less) has ended: discard the buffered output
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return looks.exit_status


def _print_each(looks: _Looks, seconds: float, console: Console, *, as_json: bool) -> None:
    between, pause = "", threading.Event()
    while True:
        view = looks.next()
        if as_json:
            say_json(view.fields)
        else:
            with console.capture() as captured:
                console.print(view.screen)
            sys.stdout.write(between + captured.get())
            between = "\n"
        sys.stdout.flush()
        pause.wait(seconds)


def _redraw(looks: _Looks, seconds: float, console: Console) -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGWINCH})
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # else the terminal would keep the other screen
    view = None
    try:
        with Live(console=console, screen=True, auto_refresh=False) as live:
            while True:
                view = looks.next()
                now = f"{_time_of_day(clock.wall_ns())}, every {seconds:g} s until Ctrl-C"
                live.update(Group(Text(now, style="dim"), view.screen), refresh=True)
                end = clock.now() + seconds
                while (left := end - clock.now()) > 0:
                    if signal.sigtimedwait({signal.SIGWINCH}, left) is not None:
                        live.refresh()
    finally:
        if view is not None:
            console.print(view.screen)
