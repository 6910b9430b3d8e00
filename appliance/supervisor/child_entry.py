"""The first code of every child: `python -m appliance.supervisor.child_entry ROLE PLAN`.

It gives up what the role must not have, checks that what the role needs can be reached by the role's
user (and says which file it is when not), and then becomes the role: it calls the entry point of one of
our own, or executes somebody else's program. A failure on the way is told on the lifeline as `Failed`,
in words for the person who started it.
"""

import contextlib
import gc
import importlib
import os
import signal
import socket
import sys
from pathlib import Path

import msgspec
import setproctitle

import appliance
from appliance.channel.channel import Channel
from appliance.channel.messages import Failed, Lifeline, Walled
from appliance.supervisor import privileges
from appliance.supervisor.sandbox import landlock, seccomp
from appliance.supervisor.sandbox.sandbox_plan import Walls
from appliance.supervisor.users import Account


class Plan(msgspec.Struct, frozen=True):
    """How a child is to be started: JSON in its arguments (nothing in it is secret)."""

    parent: int
    lifeline: int
    account: Account
    home: str
    network: bool
    files: int
    walls: Walls
    entry: str | None = None
    index: int | None = None
    path: str | None = None
    capabilities: tuple[str, ...] = ()
    takes_secret: bool = False
    secret: str | None = None
    argv: tuple[str, ...] = ()
    environment: dict[str, str] = {}
    ended_early: int = 0


def title_of(role: str, index: int | None) -> str:
    """What a process is called in lists of processes: its role, and its number from the second on."""
    return role if not index else f"{role}-{index + 1}"


class UnreachableError(Exception):
    """The role's user cannot get at something the role needs."""


def main() -> None:
    """Become the role that the arguments name."""
    role, text = sys.argv[1:3]
    plan = msgspec.json.decode(text, type=Plan)
    setproctitle.setproctitle(f"rosrv: {title_of(role, plan.index)}")
    try:
        secret = os.open(plan.secret, os.O_RDONLY | os.O_CLOEXEC) if plan.secret is not None else None
        _prepare(plan)
        if plan.argv:
            _execute(plan)
        else:
            _call(role, plan, secret)
    except (OSError, ImportError, UnreachableError, seccomp.SeccompError) as error:
        _fail(plan.lifeline, f"{role} cannot be started: {error}")


def _prepare(plan: Plan) -> None:
    # Ctrl-C on the terminal is for the supervisor: it stops the children in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    privileges.raise_file_limit(plan.files)
    privileges.be_ended_early(plan.ended_early)
    if not plan.network:
        _leave_network_if_allowed()
    privileges.drop(plan.account, parent=plan.parent, capabilities=plan.capabilities)
    _require(plan.account, plan.home, os.R_OK | os.W_OK | os.X_OK)
    if plan.path is not None:
        _require(plan.account, plan.path, os.R_OK)
    os.chdir(plan.home)
    _raise_walls(plan)


def _leave_network_if_allowed() -> None:
    if os.geteuid() == 0:
        with contextlib.suppress(PermissionError):
            privileges.leave_network()


def _raise_walls(plan: Plan) -> None:
    """Raise them, and tell the supervisor what this kernel lacks: a missing wall is seen, and ends no robot's drive.

    But for a process without network, which must not make a socket. Raises `SeccompError`.
    """
    lacks = []
    abi = 0
    try:
        abi = landlock.raise_wall(plan.walls)
    except landlock.LandlockError as error:
        lacks.append(str(error))
    lacks += landlock.lacking(abi)
    calls = "listed" if plan.walls.listed else "usual"
    try:
        seccomp.raise_wall(plan.walls)
    except seccomp.SeccompError as error:
        if not plan.network:
            raise
        calls = ""
        lacks.append(str(error))
    lifeline = Channel(socket.socket(fileno=os.dup(plan.lifeline)), Lifeline)
    lifeline.send(Walled(calls, abi, lacks))
    lifeline.close()


def _require(account: Account, path: str, mode: int) -> None:
    if os.access(path, mode):
        return
    raise UnreachableError(
        f"{path} cannot be used by user {account.name} (uid {account.uid}): "
        f"it and every folder above it must let that user in"
    )


def _call(role: str, plan: Plan, secret: int | None) -> None:
    assert plan.entry is not None  # noqa: S101  a plan has either argv or entry
    _require(plan.account, str(Path(appliance.__file__).parent), os.R_OK | os.X_OK)
    module, _, function = plan.entry.partition(":")
    from appliance.supervisor.logs import configure_logs  # noqa: PLC0415  not for somebody else's program

    configure_logs(role)
    entry = getattr(importlib.import_module(module), function)
    gc.freeze()  # what is imported stays
    arguments: list[int | Path | None] = [plan.lifeline]
    if plan.index is not None:
        arguments.append(plan.index)
    if plan.path is not None:
        arguments.append(Path(plan.path))
    if plan.takes_secret:
        arguments.append(secret)
    os.set_inheritable(plan.lifeline, False)
    entry(*arguments)


def _execute(plan: Plan) -> None:
    _require(plan.account, plan.argv[0], os.R_OK | os.X_OK)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.set_inheritable(plan.lifeline, False)  # its end tells the supervisor that the program has taken over
    os.execve(plan.argv[0], plan.argv, plan.environment)  # noqa: S606  a fixed list, no shell


def _fail(lifeline: int, reason: str) -> None:
    channel = Channel(socket.socket(fileno=lifeline), Lifeline)
    channel.send(Failed(reason))
    sys.exit(1)


if __name__ == "__main__":
    main()
