import contextlib
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.examples import examples
from tests.support.nodes import RosSession, need_ros
from tests.support.processes import ThisMachine
from tests.support.requirements import need_root
from tests.support.site import Masters, Site

_LONGEST_STORY = 40_000  # characters; of a flood there are many more

# How long an example takes says what else the machine does, and nothing of the product.
settings.register_profile("no clock", deadline=None, max_examples=examples(100))
settings.load_profile("no clock")


@pytest.fixture
def lab() -> Iterator[Lab]:
    need_root()
    with Lab("rosrv-test") as lab:
        yield lab


@pytest.fixture(scope="module")
def common_lab() -> Iterator[Lab]:
    need_root()
    with Lab("rosrv-test") as lab:
        yield lab


@pytest.fixture(scope="module")
def own_appliance(common_lab: Lab) -> Iterator[Appliance]:
    with Appliance(common_lab.host("appliance", "10.77.0.2/24"), options=("--api", "off")) as running:
        yield running


@pytest.fixture(scope="module")
def common_robot(common_lab: Lab) -> Host:
    return common_lab.host("robot", "10.77.0.10/24")


@pytest.fixture
def robot(lab: Lab) -> Host:
    return lab.host("robot", "10.77.0.10/24")


@pytest.fixture(scope="session")
def masters(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Masters]:
    need_ros()
    with contextlib.closing(Masters(tmp_path_factory.mktemp)) as masters:
        yield masters


@pytest.fixture
def appliance(masters: Masters) -> Iterator[Appliance]:
    """Yield the worker's appliance on the loopback, with an open policy and REST. The test must leave it as it was."""
    with masters.lend("appliance", "loopback") as site:
        site.appliance.ignore_earlier_records()
        yield site.appliance


@pytest.fixture(params=["plain", "appliance"])
def site(request: pytest.FixtureRequest, masters: Masters) -> Iterator[Site]:
    with masters.lend(request.param, "lab") as site:
        yield site


@pytest.fixture
def ros(request: pytest.FixtureRequest, appliance: Appliance, tmp_path: Path) -> Iterator[RosSession]:
    need_ros()
    robot = None if isinstance(appliance.host, ThisMachine) else request.getfixturevalue("common_robot")
    with RosSession(appliance.master_uri, tmp_path, robot) as session:
        yield session


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if report.failed and isinstance(item, pytest.Function):
        running: dict[int, tuple[str, Any]] = {
            id(value): (name, value)
            for name, value in item.funcargs.items()
            if callable(getattr(value, "story", None))
        }
        for name, said in running.values():
            report.sections.append((f"What {name} said", said.story()[-_LONGEST_STORY:]))
    return report
