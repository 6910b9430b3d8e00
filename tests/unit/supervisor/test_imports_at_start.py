"""What the processes import before they are ready: no library that they may never have a use for."""

import subprocess
import sys
from typing import Final

import pytest

from appliance.supervisor.roles import ROLES

NEVER: Final = {"rich", "pygments", "typer", "lark", "numpy", "pyroute2", "z3", "rosmop.run.engine"}
"""What is not needed until somebody asks for help, loads specifications or builds a namespace."""

ENTRIES: Final = {role.name: role.entry.partition(":")[0] for role in ROLES if role.entry is not None}
_BARE = {"pydantic", "rosbags", "appliance.configuration.inventory"}
_LINKED = _BARE | {"appliance.channel.admin"}
ALSO: Final = {
    "signer": _LINKED | {"appliance.configuration.settings"}, "control": _BARE,
    "relay": _LINKED | {
        "cryptography", "appliance.configuration.settings", "roswire.definitions",
    },
    "charon": _LINKED, "compiler": _LINKED, "syslog": _LINKED, "recorder": {"pydantic", "appliance.channel.admin"},
    "api": _BARE | {"fastapi", "prometheus_client", "sse_starlette", "yaml", "appliance.policy.policy"},
}  # fmt: skip


def imported(*modules: str) -> set[str]:
    """The names of everything that importing these brings."""
    program = (
        "import importlib, sys; [importlib.import_module(one) for one in sys.argv[1:]]; print(*sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *modules], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


@pytest.mark.parametrize("role", ENTRIES)
def test_a_process_imports_no_library_it_may_never_need(role: str) -> None:
    """Where nothing is monitored, no namespace is built and nobody asks for help, nothing of that is waited for."""
    found = imported("appliance.supervisor.child_entry", "appliance.supervisor.logs", ENTRIES[role])
    assert found.isdisjoint(NEVER | ALSO.get(role, set()))


def test_the_supervisor_imports_no_library_it_may_never_need() -> None:
    """Neither does `rosrv up`, which has `typer` for its flags."""
    assert imported("appliance.cli.main", "appliance.cli.up").isdisjoint(
        NEVER - {"typer"} | {"appliance.channel.admin", "appliance.configuration.inventory"}
    )


def test_the_launcher_of_a_program_has_no_loop_and_no_log() -> None:
    """What becomes rosmaster or rosout at once imports what it takes to give up its rights, no more."""
    assert imported("appliance.supervisor.child_entry").isdisjoint(
        {"asyncio", "structlog", "appliance.channel.admin"}
    )
