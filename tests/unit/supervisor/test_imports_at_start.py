import subprocess
import sys
from typing import Final

import pytest

from appliance.supervisor.roles import ROLES

pytestmark = pytest.mark.nightly

NEVER: Final = {"rich", "pygments", "typer", "lark", "numpy", "pyroute2", "z3", "rosmop.run.engine"}
"""Libraries that only help texts, specifications or a namespace need."""

ENTRIES: Final = {role.name: role.entry.partition(":")[0] for role in ROLES if role.entry is not None}
MAY: Final = {"bundles": {"rich", "pygments"}, "compiler": {"lark", "rosmop.run.engine"}}
"""httpx imports its own command-line interface if its libraries are installed. The compiler runs while it compiles."""

_BARE = {"rosbags", "appliance.configuration.inventory"}
_LINKED = _BARE | {"appliance.channel.admin"}
_NO_SETTINGS = _LINKED | {"pydantic", "appliance.configuration.settings"}
ALSO: Final = {
    "signer": _NO_SETTINGS, "control": {"rosbags"},
    "relay": _NO_SETTINGS | {"cryptography"},
    "charon": _NO_SETTINGS, "compiler": _LINKED | {"pydantic"}, "syslog": _LINKED,
    "fleet": _LINKED,
    "recorder": {"appliance.channel.admin"},
    "api": _BARE | {"fastapi", "prometheus_client", "sse_starlette", "yaml", "appliance.policy.policy"},
}  # fmt: skip


def imported(*modules: str) -> set[str]:
    program = (
        "import importlib, sys; [importlib.import_module(one) for one in sys.argv[1:]]; print(*sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *modules], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


@pytest.mark.parametrize("role", ENTRIES)
def test_a_process_imports_no_library_it_may_never_need(role: str) -> None:
    found = imported("appliance.supervisor.child_entry", "appliance.supervisor.logs", ENTRIES[role])
    assert found.isdisjoint(NEVER - MAY.get(role, set()) | ALSO.get(role, set()))


def test_the_supervisor_imports_no_library_it_may_never_need() -> None:
    assert imported("appliance.cli.main", "appliance.cli.up").isdisjoint(
        NEVER - {"typer"} | {"appliance.channel.admin", "appliance.configuration.inventory"}
    )


def test_the_launcher_of_a_program_has_no_loop_and_no_log() -> None:
    assert imported("appliance.supervisor.child_entry").isdisjoint(
        {"asyncio", "structlog", "appliance.channel.admin"}
    )
