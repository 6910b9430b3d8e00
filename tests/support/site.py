"""The same robot twice: behind a plain ROSMaster and behind the appliance.

What a test promises of unmodified nodes it promises in both modes: the plain one shows that the test is good,
the other one that the robot does not notice.
"""

from pathlib import Path
from typing import Self

from examples.landshark.lab import Host, Lab
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.rosmaster import PlainMaster


class MasterSite:
    """A place with a master of one mode, `plain` or `appliance`, for the length of a `with`."""

    def __init__(self, mode: str, master: PlainMaster | Appliance) -> None:
        self.mode = mode
        self.master = master

    @property
    def master_uri(self) -> str:
        """What ROS_MASTER_URI says."""
        return self.master.master_uri

    def story(self) -> str:
        """What the master said, for the message of a failure."""
        return self.master.story()

    def __enter__(self) -> Self:
        self.master.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self.master.__exit__(*exc)


class Site(MasterSite):
    """A master of one mode on 10.77.0.2, and hosts for nodes: `robot` (10.77.0.10), `ocu` (10.77.0.20)."""

    def __init__(self, lab: Lab, mode: str, home: Path, policy: str = OPEN_POLICY) -> None:
        self.robot = lab.host("robot", "10.77.0.10/24")
        self.ocu = lab.host("ocu", "10.77.0.20/24")
        middle = lab.host("master", "10.77.0.2/24")
        super().__init__(mode, PlainMaster(home, middle) if mode == "plain" else for_nodes(middle, policy))


def for_nodes(host: Host | None = None, policy: str = OPEN_POLICY) -> Appliance:
    """An appliance as nodes see it: without REST."""
    return Appliance(host, policy=policy, options=("--api", "off"))
