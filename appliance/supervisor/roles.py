"""The table of processes, with the user, the permissions and the start of each process."""

import pkgutil
import shutil
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from appliance.base.shipped import DPKG
from appliance.configuration.sections import DEFAULTS, Sections
from appliance.features.table import FEATURES
from appliance.supervisor.errors import StartError
from appliance.supervisor.port_check import first_free
from appliance.supervisor.role import ExternalProgram, Facts, Role, SharedMemory
from appliance.supervisor.sandbox.folders import executables_of, folders_of
from appliance.supervisor.sandbox.sandbox_plan import NETWORK, ROUTES, SandboxPlan

ROSMASTER = Path("/usr/bin/rosmaster")
_ROSMASTER_LOGGING = Path(__file__).with_name("rosmaster_logging.conf")
ROSOUT = Path("/usr/lib/rosout/rosout")
SYSTEM_PYTHON = Path("/usr/bin/python3")
_SHORTEST_SLICE = 100_000  # nanoseconds, the kernel's minimum
_RELAY_NICE = (
    -10
)  # ten times the share of a busy program, so that no stop waits behind it; only while one is busy
_CONTROL_NICE = -5  # three times the share, because all nodes of a starting robot wait for it
ROS_PROGRAMS = {ROSMASTER: "python3-rosmaster", ROSOUT: "rosout"}


def _of_ros(facts: Facts, part: str, master: str) -> dict[str, str]:
    """Return the environment of a ROS program. ROS_IP makes rosmaster listen on loopback only."""
    return {
        "ROS_IP": "127.0.0.1",
        "ROS_MASTER_URI": master,
        "ROS_LOG_DIR": str(facts.part(part) / "log"),
        "ROS_PYTHON_LOG_CONFIG_FILE": str(_ROSMASTER_LOGGING),
        # rosout would write up to a gigabyte of logs that are never read; its subscribers get the messages anyway.
        "ROSOUT_DISABLE_FILE_LOGGING": "1",
    }


def _messages_at(ports: range | None) -> tuple[str, ...]:
    """Return the option for the first free port, because an earlier run's connections may occupy one for a minute."""
    return () if ports is None else (f"__tcpros_server_port:={first_free(ports)}",)


# Most roles read the configuration and talk to control.
_ours = partial(Role, path=lambda facts: facts.config, links=("control",))
_OF_FEATURES = tuple(role for feature in FEATURES for role in feature.roles)
ROLES = (
    *(role for role in _OF_FEATURES if role.after is None and not role.on_demand),
    Role(
        "rosmaster", "rosmaster", "rosmaster",
        program=lambda facts: ExternalProgram(
            (str(SYSTEM_PYTHON), "-s", str(ROSMASTER), "--core", "-p", str(facts.rosmaster_port)),
            _of_ros(facts, "rosmaster", f"http://127.0.0.1:{facts.rosmaster_port}"),
        ),
        asks=True, outlives_control=True, files=8192,
        sandbox=lambda facts: SandboxPlan(
            families=ROUTES,
            programs=executables_of(SYSTEM_PYTHON),
            binds=(facts.rosmaster_port,),
            connects=None,  # it calls the master-side endpoints, whose port the firewall permits
        ),
    ),
    _ours(
        "signer", "rosrv-signer", "signer", "appliance.ipsec.signer:main",
        secret=lambda facts: facts.ca_passphrase_file, network=False, outlives_control=True,
        outlives_takeover=True,
    ),
    _ours(
        "relay", "rosrv-relay", "relay", "appliance.supervisor.relay_entry:main",
        ended_early=300, indexed=True, files=65_536, nice=_RELAY_NICE, nice_if_busy=True, slice_ns=_SHORTEST_SLICE,
        sandbox=lambda _facts: SandboxPlan(allowlist=True, families=NETWORK, connects=None),
    ),
    _ours(
        "control", "rosrv", "control", "appliance.control.process:main",
        ended_early=100, files=65_536, nice=_CONTROL_NICE,
        links=(
            "relay", "signer", "compiler", "api", *(role.name for role in _OF_FEATURES),
        ),
        readable_by="rosrv-api", inputs=lambda facts: facts.control_reads,
        sandbox=lambda facts: SandboxPlan(
            allowlist=True, families=ROUTES, reads=(*folders_of(*facts.control_reads), str(DPKG)), binds=None,
            connects=None,
        ),
    ),
    Role(
        "compiler", "rosrv-compiler", "compiler", "appliance.compiler.process:main",
        ended_early=700, nice=5, links=("control",), network=False, dispensable=True, on_demand=True,
        sandbox=lambda _facts: SandboxPlan(allowlist=True),
    ),
    Role(
        "rosout", "rosrv-rosout", "rosout",
        program=lambda facts: ExternalProgram(
            (str(ROSOUT), *_messages_at(facts.rosout_ports)),
            _of_ros(facts, "rosout", str(facts.rosout_master)),
        ),
        after="control",
        sandbox=lambda _facts: SandboxPlan(
            families=ROUTES,
            programs=executables_of(ROSOUT),
            binds=None,  # the kernel chooses the port of its node API; the firewall limits access
            connects=None,
        ),
    ),
    _ours(
        "api", "rosrv-api", "api", "appliance.api.process:main",
        ended_early=800, nice=5, files=4096, after="control", listens=True, dispensable=True, stands_by=True,
        sandbox=lambda facts: SandboxPlan(
            allowlist=True,
            reads=(
                str(facts.part("control")),
                *(str(facts.part(role.part)) for role in _OF_FEATURES if role.readable_by == "rosrv-api"),
            ),
        ),
    ),
    *(role for role in _OF_FEATURES if role.after is not None or role.on_demand),
)  # fmt: skip
"""The rows in the order of their start."""


def roles_of(
    *,
    sections: Sections = DEFAULTS,
    api: bool = True,
    paired: bool = False,
) -> tuple[Role, ...]:
    """Return the rows to start. Raises `StartError` if a ROS program is missing."""
    require_programs(ROS_PROGRAMS)
    wanted = {"api": api}
    return tuple(
        role
        for role in ROLES
        if wanted.get(role.name, True) and role.configured(sections) and (paired or not role.paired)
    )


def memories(sections: Sections, relays: int) -> tuple[SharedMemory, ...]:
    """Make the memory of all roles. Raises `StartError`."""
    made = (pkgutil.resolve_name(role.memory)(sections, relays) for role in ROLES if role.memory)
    return tuple(memory for memory in made if memory is not None)


def require_programs(packages: Mapping[Path, str]) -> None:
    """Raise `StartError` if a program is missing, with the package to install."""
    for program, package in packages.items():
        if shutil.which(program) is None:
            raise StartError(f"{program} is missing: install it with `apt install {package}`")
