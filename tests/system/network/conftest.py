from collections.abc import Iterator

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.adopted_robot import POLICY
from tests.support.appliance import Appliance
from tests.support.nodes import need_ros
from tests.support.requirements import need_program, need_root


@pytest.fixture
def lab(request: pytest.FixtureRequest) -> Iterator[Lab]:
    need_root()
    need_program("nft", "nftables")
    with Lab(request.path.stem.replace("test_", "rosrv-").replace("_", "-")) as one:
        yield one


@pytest.fixture
def protected(lab: Lab) -> Host:
    return lab.host("protected", "10.77.0.2/24", "fd77::2/64")


@pytest.fixture
def robot(lab: Lab) -> Host:
    return lab.host("robot", "10.77.0.10/24", "fd77::10/64")


@pytest.fixture
def attacker(lab: Lab) -> Host:
    return lab.host("attacker", "10.77.0.66/24", "fd77::66/64")


@pytest.fixture
def host(lab: Lab) -> Host:
    """Return the computer of a robot that is adopted."""
    need_ros()
    return lab.host("robot", "10.77.0.10/24")


@pytest.fixture
def appliance(host: Host) -> Iterator[Appliance]:
    appliance = Appliance(host, isolation="netns", policy=POLICY)
    try:
        yield appliance
    finally:
        appliance.stop()
        appliance.close()
