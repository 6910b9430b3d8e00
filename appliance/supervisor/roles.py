"""The table of processes: who each is, what it may have, and how it is started.

To add a process, add its row to `roles_of`. A role is one of our own programs (`entry`: a function that
is given the lifeline) or somebody else's (`program`: what is executed, and its environment).
"""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from appliance.supervisor.errors import StartError

ROSMASTER = Path("/usr/bin/rosmaster")
ROSOUT = Path("/usr/lib/rosout/rosout")
SYSTEM_PYTHON = Path("/usr/bin/python3")


@dataclass(frozen=True)
class Facts:
    """What the rows of the table need to know: where things are, and what control said when it was ready."""

    state: Path
    config: Path
    rosmaster_port: int
    rosout_master: str | None = None
    ca_passphrase_file: Path | None = None

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
    `dispensable`: when it cannot serve, the others go on without it. `on_demand`: started when control asks for it.
    `group` is the user whose group it is in instead of one of its own, to read what is `readable_by` that.
    `capabilities` are those of `privileges.SUPERVISORS` that it keeps. `secret` is a file that its user may not read:
    it is opened before the privileges are given up, and `entry` gets the descriptor (or None) as its last argument.
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


def roles_of(
    *, rosmaster: Path = ROSMASTER, rosout: Path = ROSOUT, api: bool = True, syslog: bool = False
) -> tuple[Role, ...]:
    """The roles in the order they are started, with or without REST and the forwarder of the audit log.

    Raises `StartError` when a program is missing.
    """
    _find(rosmaster, "python3-rosmaster")
    _find(rosout, "rosout")
    roles = (
        Role(
            name="rosmaster",
            user="rosmaster",
            part="rosmaster",
            program=lambda facts: Program(
                (str(SYSTEM_PYTHON), "-s", str(rosmaster), "--core", "-p", str(facts.rosmaster_port)),
                {
                    "ROS_IP": "127.0.0.1",  # rosmaster binds loopback only because of this
                    "ROS_MASTER_URI": f"http://127.0.0.1:{facts.rosmaster_port}",
                    "ROS_LOG_DIR": str(facts.part("rosmaster") / "log"),
                },
            ),
            asks=True,
            outlives_control=True,
            files=8192,
        ),
        Role(
            name="signer",
            user="rosrv-signer",
            part="signer",
            entry="appliance.ipsec.signer:main",
            path=lambda facts: facts.config,
            secret=lambda facts: facts.ca_passphrase_file,
            links=("control",),
            network=False,
            outlives_control=True,
        ),
        Role(
            name="relay",
            user="rosrv-relay",
            part="relay",
            entry="appliance.supervisor.relay_entry:main",
            ended_early=300,
            indexed=True,
            path=lambda facts: facts.config,
            links=("control",),
            files=65_536,
        ),
        Role(
            name="control",
            user="rosrv",
            part="control",
            entry="appliance.master.process:main",
            ended_early=100,
            path=lambda facts: facts.config,
            links=("relay", "signer", "api", "charon", "syslog"),
            files=65_536,
            readable_by="rosrv-api",
        ),
        Role(
            name="rosout",
            user="rosmaster",
            part="rosmaster",
            program=lambda facts: Program(
                (str(rosout),),
                {
                    "ROS_IP": "127.0.0.1",
                    "ROS_MASTER_URI": str(facts.rosout_master),
                    "ROS_LOG_DIR": str(facts.part("rosmaster") / "log"),
                },
            ),
            after="control",
        ),
        Role(
            name="api",
            user="rosrv-api",
            part="api",
            entry="appliance.api.process:main",
            ended_early=800,
            path=lambda facts: facts.config,
            links=("control",),
            after="control",
            listens=True,
            dispensable=True,
            files=4096,
        ),
        Role(
            name="charon",
            user="rosrv-ipsec",
            part="ipsec",
            entry="appliance.ipsec.process:main",
            path=lambda facts: facts.part("ipsec"),
            links=("control",),
            dispensable=True,
            on_demand=True,
            capabilities=("NET_ADMIN", "NET_BIND_SERVICE"),
        ),
        Role(
            name="syslog",
            user="rosrv-syslog",
            part="syslog",
            entry="appliance.forwarding.process:main",
            ended_early=600,
            path=lambda facts: facts.config,
            links=("control",),
            after="control",
            dispensable=True,
            group="rosrv-api",
        ),
    )
    left_out = {name for name, wanted in (("api", api), ("syslog", syslog)) if not wanted}
    return tuple(role for role in roles if role.name not in left_out)


def _find(program: Path, package: str) -> None:
    if shutil.which(program) is None:
        raise StartError(f"{program} is not there: install it with `apt install {package}`")
