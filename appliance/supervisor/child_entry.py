"""Start a child process: `python -m appliance.supervisor.child_entry ROLE PLAN`.

The child drops its privileges first. It reports a failure over the lifeline as `Failed`.
"""

import contextlib
import gc
import os
import pkgutil
import signal
import socket
import sys
from pathlib import Path

import msgspec
import setproctitle

import appliance
from appliance.base.owner_access import FileLender
from appliance.channel.channel import Channel
from appliance.channel.messages import Failed, Lifeline, Walled
from appliance.supervisor import privileges
from appliance.supervisor.input_lender import Borrower
from appliance.supervisor.sandbox import landlock, private_view, seccomp
from appliance.supervisor.sandbox.private_view import PrivateView
from appliance.supervisor.sandbox.sandbox_plan import SandboxPlan
from appliance.supervisor.users import Account

_INCOMPLETE = "the installation is incomplete: install the package again, or run 'make setup' in the sources"


class LaunchPlan(msgspec.Struct, frozen=True):
    """The plan of a child's start, as JSON in its arguments, without secrets."""

    parent: int
    lifeline: int
    account: Account
    home: str
    network: bool
    files: int
    sandbox: SandboxPlan
    lender: int | None = None
    view: PrivateView | None = None
    entry: str | None = None
    index: int | None = None
    path: str | None = None
    capabilities: tuple[str, ...] = ()
    takes_secret: bool = False
    secret: str | None = None
    argv: tuple[str, ...] = ()
    environment: dict[str, str] = {}
    ended_early: int = 0
    nice: int = 0
    slice_ns: int = 0


def title_of(role: str, index: int | None) -> str:
    return role if not index else f"{role}-{index + 1}"


class UnreachableError(Exception):
    """The role's user cannot reach a needed file."""


def main() -> None:
    role, text = sys.argv[1:3]
    plan = msgspec.json.decode(text, type=LaunchPlan)
    setproctitle.setproctitle(f"rosrv: {title_of(role, plan.index)}")
    try:
        secret = os.open(plan.secret, os.O_RDONLY | os.O_CLOEXEC) if plan.secret is not None else None
        _prepare(plan)
        if plan.argv:
            _execute(plan)
        else:
            _call(role, plan, secret)
    except ImportError as error:
        _fail(plan.lifeline, f"{role} cannot be started: {error}; {_INCOMPLETE}")
    except (OSError, UnreachableError, private_view.ViewError, seccomp.SeccompError) as error:
        _fail(plan.lifeline, f"{role} cannot be started: {error}")


def _prepare(plan: LaunchPlan) -> None:
    # Ctrl-C on the terminal is for the supervisor, which stops the children in order.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    privileges.raise_file_limit(plan.files)
    privileges.raise_oom_score(plan.ended_early)
    # With its niceness a process runs as soon on a busy machine, and short turns would delay it on a quiet one.
    if not privileges.add_niceness(plan.nice) and plan.slice_ns:
        privileges.shorten_slice(plan.slice_ns)
    if plan.view is not None:
        private_view.enter(plan.view, plan.account)
    if not plan.network:
        _leave_network_if_allowed()
    privileges.drop_privileges(plan.account, parent=plan.parent, capabilities=plan.capabilities)
    _require(plan.account, plan.home, os.R_OK | os.W_OK | os.X_OK)
    if plan.path is not None:
        _require(plan.account, plan.path, os.R_OK)
    os.chdir(plan.home)
    _enter_sandbox(plan)


def _leave_network_if_allowed() -> None:
    if os.geteuid() == 0:
        with contextlib.suppress(PermissionError):
            privileges.leave_network()


def _enter_sandbox(plan: LaunchPlan) -> None:
    """Limit system calls, files and ports, and report what the kernel lacks.

    Without a filter, a role without network does not start, because it could make a socket.
    """
    lacks = []
    abi = 0
    try:
        abi = landlock.restrict(plan.sandbox)
    except landlock.LandlockError as error:
        lacks.append(str(error))
    lacks += landlock.lacking(abi)
    calls = "listed" if plan.sandbox.allowlist else "usual"
    try:
        seccomp.load_filter(plan.sandbox)
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
        f"give that user access to it and to every folder above it"
    )


def _call(role: str, plan: LaunchPlan, secret: int | None) -> None:
    assert plan.entry is not None  # noqa: S101  a plan has either argv or entry
    _require(plan.account, str(Path(appliance.__file__).parent), os.R_OK | os.X_OK)
    from appliance.supervisor.logs import configure_logs  # noqa: PLC0415  not for an external program

    configure_logs(role)
    sys.stdout = sys.stderr
    entry = pkgutil.resolve_name(plan.entry)  # a child imports only the modules of its role
    gc.freeze()  # imported modules live as long as the process, so the collector can skip them
    if plan.lender is not None:
        os.set_inheritable(plan.lender, False)
        FileLender.install(Borrower(socket.socket(fileno=plan.lender)).open)
    arguments: list[int | Path | None] = [plan.lifeline]
    if plan.index is not None:
        arguments.append(plan.index)
    if plan.path is not None:
        arguments.append(Path(plan.path))
    if plan.takes_secret:
        arguments.append(secret)
    os.set_inheritable(plan.lifeline, False)
    entry(*arguments)


def _execute(plan: LaunchPlan) -> None:
    _require(plan.account, plan.argv[0], os.R_OK | os.X_OK)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.set_inheritable(plan.lifeline, False)  # exec closes it: the supervisor sees that the program runs
    os.execve(plan.argv[0], plan.argv, plan.environment)  # noqa: S606  a fixed list, no shell


def _fail(lifeline: int, reason: str) -> None:
    channel = Channel(socket.socket(fileno=lifeline), Lifeline)
    channel.send(Failed(reason))
    sys.exit(1)


if __name__ == "__main__":
    main()
