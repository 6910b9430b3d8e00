"""Define the `rosrv` command: the table of the core's verbs, and the handling of errors that the verbs do not
catch.
"""

import errno
import os
import pkgutil
import sys
import traceback
from typing import Annotated

import typer

from appliance import __version__
from appliance.base.counted import counted
from appliance.base.engine_thread import InCaller
from appliance.base.log_output import replace_stderr
from appliance.base.user_errors import UserError, with_remedy
from appliance.cli.first_contact import first_contact
from appliance.cli.lazy import application
from appliance.cli.verb_table import Group, Verb, Verbs, joined
from rosmop.tool.terminal import printable

_OF_THE_MACHINE = (errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""Errors that an operator can remove, even where a verb does not expect them."""

VERBS: Verbs = {
    "up": Verb("up:up"),
    "status": Verb("status_verb:status"),
    "version": Verb("version:version"),
    "config": Group(
        "Check or show the configuration.",
        {"check": Verb("config_verbs:check"), "show": Verb("config_verbs:show")},
    ),
    "certificate": Verb("certificate_verb:certificate"),
}


def feature_verbs() -> tuple[Verbs, ...]:
    """Import the table of features, which most verbs of the core do not need, and return their verbs."""
    return tuple(tool.verbs for tool in pkgutil.resolve_name("appliance.features.table:TOOLS"))


def all_verbs() -> Verbs:
    return joined(VERBS, *feature_verbs())


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rosrv {__version__}")
        raise typer.Exit


def _global_options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version and exit.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    pass


app = application(
    VERBS,
    further=feature_verbs,
    callback=_global_options,
    panels=True,
    name="rosrv",
    summary="A network-security appliance for ROS 1 robots.",
)


def main() -> None:
    _open_closed_streams()
    replace_stderr(_lost, InCaller, waits=True)  # a note must not end a verb between two of its effects
    sys.argv[1:] = _asking_for_help(_without_old_flags(sys.argv[1:]))
    if not sys.argv[1:] and sys.stdin.isatty() and sys.stdout.isatty():
        sys.exit(first_contact())
    try:
        app()
    except Exception as error:  # noqa: BLE001  the last resort: print the error and its place
        if isinstance(error, UserError):
            sys.stderr.write(f"rosrv: {error}\n")
            sys.exit(1)
        if isinstance(error, OSError) and error.errno in _OF_THE_MACHINE:
            sys.stderr.write(f"rosrv: {printable(with_remedy(error, error.filename or 'output'))}\n")
            sys.exit(2)
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{last.filename}:{last.lineno}"
        sys.stderr.write(
            f"rosrv: a defect in rosrv, please report it: {type(error).__name__}: {error} ({where})\n"
        )
        sys.exit(70)


def _lost(lines: int, _since: str) -> str:
    return f"rosrv: {counted(lines, 'line')} of this output were lost\n"


def _open_closed_streams() -> None:
    """Open closed streams (`>&-`), so that no other file gets their descriptors."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    sys.stdin = sys.stdin or os.fdopen(0)
    sys.stdout = sys.stdout or os.fdopen(1, "w", encoding="utf-8")
    sys.stderr = sys.stderr or os.fdopen(2, "w", encoding="utf-8")


_OLD_FLAGS = {"-list": "list", "-rvstate": "rvstate", "-enable": "enable", "-disable": "disable"}
"""The flags of the original ROSRV."""


def _without_old_flags(arguments: list[str]) -> list[str]:
    verb = _OLD_FLAGS.get(arguments[0]) if arguments else None
    return arguments if verb is None else ["monitor", verb, *arguments[1:]]


def _asking_for_help(arguments: list[str]) -> list[str]:
    if "help" not in arguments[:2]:
        return arguments
    return [*(word for word in arguments[:2] if word != "help"), *arguments[2:], "--help"]


if __name__ == "__main__":
    main()
