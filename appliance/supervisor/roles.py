"""The table of processes: who each is, what it may have, and how it is started.

To add a process, add its row to `ROLES`. A role is one of our own programs (`entry`: a function that
is given the lifeline) or somebody else's (`program`: what is executed, and its environment).
"""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from appliance.base.shipped import DPKG
from appliance.supervisor.errors import StartError
from appliance.supervisor.port_check import first_free
from appliance.supervisor.sandbox.folders import around, runnable
from appliance.supervisor.sandbox.sandbox_plan import NETWORK, ROUTES, Walls

ROSMASTER = Path("/usr/bin/rosmaster")
_ROSMASTER_LOGGING = Path(__file__).with_name("rosmaster_logging.conf")
ROSOUT = Path("/usr/lib/rosout/rosout")
SYSTEM_PYTHON = Path("/usr/bin/python3")
ROS_PROGRAMS = {ROSMASTER: "python3-rosmaster", ROSOUT: "rosout"}


@dataclass(frozen=True)
class Facts:
    """What the rows of the table need to know: where things are, and what control said when it was ready."""

    state: Path
    config: Path
    rosmaster_port: int
    rosout_master: str | None = None
    rosout_ports: range | None = None  # None: where the kernel likes
    ca_passphrase_file: Path | None = None
    control_reads: tuple[Path, ...] = ()
    syslog_reads: tuple[Path, ...] = ()
    syslog_port: int | None = None  # of TCP

    def part(self, name: str) -> Path:
        """The part of the state directory with this name."""
        return self.state / name


@dataclass(frozen=True)
class Program:
    """A program that is not ours: what is executed and the environment it gets besides HOME and PATH."""

    argv: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Role:
    """One row of the table.

    `part` is the folder of the state directory that belongs to the role. `links` are the roles it talks
    to. `path` gives the last argument of `entry`; `indexed` roles get their number. `asks` says that
    the supervisor asks it over HTTP whether it is alive (for a program that knows no lifeline). `after`
    is the role that must be ready first. `outlives_control` roles are stopped last. `files` is the
    limit on open files. `readable_by` is the user whose group may pass through `part` and read what there is
    readable for it. `listens`: each of its lives is given the listening socket that the supervisor holds for it.
    `dispensable`: when it cannot serve, the others go on without it. `on_demand`: started when control asks for it,
    and not again after it has ended by itself with status 0.
    `group` is the user whose group it is in instead of one of its own, to read what is `readable_by` that.
    `capabilities` are those of `privileges.SUPERVISORS` that it keeps. `secret` is a file that its user may not read:
    it is opened before the privileges are given up, and `entry` gets the descriptor (or None) as its last argument.
    `walls` say what it may ask of the kernel, and which files and ports it has besides its part and the system.
    `ended_early`: how much sooner than others the kernel ends it where memory is short (`oom_score_adj`, 0 to 1000).
    """

    name: str
    user: str
    part: str
    entry: str | None = None
    program: Callable[[Facts], Program] | None = None
    path: Callable[[Facts], Path] | None = None
    indexed: bool = False
    links: tuple[str, ...] = ()
    network: bool = True
    asks: bool = False
    after: str | None = None
    outlives_control: bool = False
    files: int = 1024
    readable_by: str | None = None
    listens: bool = False
    dispensable: bool = False
    on_demand: bool = False
    capabilities: tuple[str, ...] = ()
    group: str | None = None
    secret: Callable[[Facts], Path | None] | None = None
    ended_early: int = 0
    walls: Callable[[Facts], Walls] = lambda _facts: Walls(listed=True)


def _of_ros(facts: Facts, part: str, master: str) -> dict[str, str]:
    """The environment of a program of ROS; rosmaster binds loopback only because of ROS_IP."""
    return {
        "ROS_IP": "127.0.0.1",
        "ROS_MASTER_URI": master,
        "ROS_LOG_DIR": str(facts.part(part) / "log"),
        "ROS_PYTHON_LOG_CONFIG_FILE": str(_ROSMASTER_LOGGING),
        # rosout would write a gigabyte of what nodes say, which nobody reads: they say it to who subscribes.
        "ROSOUT_DISABLE_FILE_LOGGING": "1",
    }


def _messages_at(ports: range | None) -> tuple[str, ...]:
    """The argument by which roscpp serves messages at the first of these ports that is free.

    A life that ended may have left connections behind, which keep its port for a minute.
    """
    return () if ports is None else (f"__tcpros_server_port:={first_free(ports)}",)


# Most of ours read the configuration and talk to control.
_ours = partial(Role, path=lambda facts: facts.config, links=("control",))
ROLES = (
    Role(
        "rosmaster", "rosmaster", "rosmaster",
        program=lambda facts: Program(
            (str(SYSTEM_PYTHON), "-s", str(ROSMASTER), "--core", "-p", str(facts.rosmaster_port)),
            _of_ros(facts, "rosmaster", f"http://127.0.0.1:{facts.rosmaster_port}"),
        ),
        asks=True, outlives_control=True, files=8192,
        walls=lambda facts: Walls(
            families=ROUTES,
            programs=runnable(SYSTEM_PYTHON),
            binds=(facts.rosmaster_port,),
            reaches=None,  # the inner faces: the firewall knows their port
        ),
    ),
    _ours(
        "signer", "rosrv-signer", "signer", "appliance.ipsec.signer:main",
        secret=lambda facts: facts.ca_passphrase_file, network=False, outlives_control=True,
    ),
    _ours(
        "relay", "rosrv-relay", "relay", "appliance.supervisor.relay_entry:main",
        ended_early=300, indexed=True, files=65_536,
        walls=lambda _facts: Walls(listed=True, families=NETWORK, reaches=None),
    ),
    _ours(
        "control", "rosrv", "control", "appliance.control.process:main",
        ended_early=100, files=65_536,
        links=("relay", "signer", "compiler", "api", "charon", "syslog", "recorder"),
        readable_by="rosrv-api",
        walls=lambda facts: Walls(
            listed=True, families=ROUTES, reads=(*around(*facts.control_reads), str(DPKG)), binds=None,
            reaches=None,
        ),
    ),
    Role(
        "compiler", "rosrv-compiler", "compiler", "appliance.compiler.process:main",
        ended_early=700, links=("control",), network=False, dispensable=True, on_demand=True,
        walls=lambda _facts: Walls(listed=True),
    ),
    Role(
        "rosout", "rosrv-rosout", "rosout",
        program=lambda facts: Program(
            (str(ROSOUT), *_messages_at(facts.rosout_ports)),
            _of_ros(facts, "rosout", str(facts.rosout_master)),
        ),
        after="control",
        walls=lambda _facts: Walls(
            families=ROUTES,
            programs=runnable(ROSOUT),
            binds=None,  # its API is where the kernel likes; the firewall says who gets there
            reaches=None,
        ),
    ),
    _ours(
        "api", "rosrv-api", "api", "appliance.api.process:main",
        ended_early=800, files=4096, after="control", listens=True, dispensable=True,
        walls=lambda facts: Walls(
            listed=True, reads=(str(facts.part("control")), str(facts.part("recordings")))
        ),
    ),
    _ours(
        "charon", "rosrv-ipsec", "ipsec", "appliance.ipsec.process:main",
        path=lambda facts: facts.part("ipsec"), dispensable=True, on_demand=True,
        capabilities=("NET_ADMIN", "NET_BIND_SERVICE"),
        walls=lambda _facts: Walls(
            families=ROUTES,
            programs=("/usr", "/lib", "/lib64"),
            writes=("/dev/net", "/proc/sys/net"),
        ),
    ),
    _ours(
        "syslog", "rosrv-syslog", "syslog", "appliance.forwarding.process:main",
        ended_early=600, after="control", dispensable=True, group="rosrv-api",
        walls=lambda facts: Walls(
            listed=True,
            families=ROUTES,
            reads=(str(facts.part("control")), *around(*facts.syslog_reads)),
            reaches=None if facts.syslog_port is None else (facts.syslog_port,),
        ),
    ),
    _ours(
        "recorder", "rosrv-recorder", "recordings", "appliance.recorder.process:main",
        ended_early=500, after="control", dispensable=True, group="rosrv-api", readable_by="rosrv-api",
        network=False,
        walls=lambda facts: Walls(listed=True, reads=(str(facts.part("control")),)),
    ),
)  # fmt: skip
"""In the order they are started."""


def roles_of(*, api: bool = True, syslog: bool = False, recorder: bool = False) -> tuple[Role, ...]:
    """The roles of an appliance with or without REST, the forwarder of the audit log, the recorder.

    Raises `StartError` when a program of ROS is missing.
    """
    require_programs(ROS_PROGRAMS)
    wanted = {"api": api, "syslog": syslog, "recorder": recorder}
    return tuple(role for role in ROLES if wanted.get(role.name, True))


def require_programs(packages: Mapping[Path, str]) -> None:
    """Raises `StartError` when one of the programs is missing; it says which package has it."""
    for program, package in packages.items():
        if shutil.which(program) is None:
            raise StartError(f"{program} is not there: install it with `apt install {package}`")
