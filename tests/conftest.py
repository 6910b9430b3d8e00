"""Fixtures that tests with real nodes share, each ends what it started; how many run at once; what is tried again."""

import contextlib
import gc
import os
import signal
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from appliance.network import interfaces
from appliance.network.namespaces import Namespace, has_privileges
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.examples import examples
from tests.support.nodes import RosSession, has_ros
from tests.support.outside import outside
from tests.support.requirements import need_root, needs
from tests.support.rosmaster import PlainMaster
from tests.support.site import Site

_LONGEST_STORY = 40_000  # characters; of a flood there are many more

# How long an example takes says what else the machine does, and nothing of the product.
settings.register_profile("no clock", deadline=None, max_examples=examples(100))
settings.load_profile("no clock")


@pytest.fixture
def lab() -> Iterator[Lab]:
    """An empty Ethernet to put hosts on."""
    need_root()
    with Lab("rosrv-test") as lab:
        yield lab


@pytest.fixture(scope="module")
def common_lab() -> Iterator[Lab]:
    """An Ethernet that the tests of a file share."""
    need_root()
    with Lab("rosrv-test") as lab:
        yield lab


@pytest.fixture(scope="module")
def appliance(common_lab: Lab) -> Iterator[Appliance]:
    """An appliance that lets everything pass, on a host of the common lab (10.77.0.2), firewall in force."""
    with Appliance(common_lab.host("appliance", "10.77.0.2/24"), options=("--api", "off")) as running:
        yield running


@pytest.fixture(scope="module")
def common_robot(common_lab: Lab) -> Host:
    """The host of the common lab that the robot's nodes run on (10.77.0.10)."""
    return common_lab.host("robot", "10.77.0.10/24")


@pytest.fixture
def plain_master(lab: Lab, tmp_path: Path) -> Iterator[PlainMaster]:
    """A plain ROSMaster where the appliance would be."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    with PlainMaster(tmp_path, lab.host("master", "10.77.0.2/24")) as running:
        yield running


@pytest.fixture
def robot(lab: Lab) -> Host:
    """The host the robot's nodes run on (10.77.0.10)."""
    return lab.host("robot", "10.77.0.10/24")


@pytest.fixture(scope="module", params=["plain", "appliance"])
def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A robot behind a plain master, and the same robot behind the appliance: a test of it runs with both."""
    need_root()
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    with Lab("rosrv-test") as lab, Site(lab, request.param, tmp_path_factory.mktemp("master")) as site:
        yield site


@pytest.fixture
def ros(site: Site, tmp_path: Path) -> Iterator[RosSession]:
    """The robot's nodes and tools of one test."""
    with RosSession(site.master_uri, tmp_path, site.robot) as session:
        yield session


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add what the nodes and the appliance said to the report of a failure."""
    report = yield
    if report.failed and isinstance(item, pytest.Function):
        running: dict[int, tuple[str, Any]] = {
            id(value): (name, value) for name, value in item.funcargs.items() if hasattr(value, "story")
        }
        for name, said in running.values():
            report.sections.append((f"What {name} said", said.story()[-_LONGEST_STORY:]))
    return report


@pytest.hookimpl(trylast=True)  # pytest-rerunfailures has called its other half by then
def pytest_configure(config: pytest.Config) -> None:
    """Have programs listen to SIGINT; give each worker of pytest-xdist a loopback of its own, as root.

    What a script starts in the background ignores SIGINT, and so does every program that it starts: tests that
    interrupt one would wait for its end until their limit.

    A node that a test killed is remembered by its master with a port; on a common loopback the next node that takes
    this port may be another worker's. It would answer for the dead one, or be told to shut down in its place.
    """
    # What was collected stays: the collector would look through millions of objects again and again.
    gc.set_threshold(700, 10, 100)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if not hasattr(config, "workerinput") or not has_privileges():
        return
    namespace = Namespace(f"rosrv-test-worker.{os.getpid()}").create()
    inside = contextlib.ExitStack()
    inside.enter_context(namespace.entered())
    config.add_cleanup(inside.close)
    interfaces.set_link(Namespace.own(), "lo", up=True)
    namespace.delete()  # only the name: it ends with the worker's last process


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """`-n auto`: twice as many as there are cores, for all wait much; `-n logical`: one more, for few wait."""
    cores = len(os.sched_getaffinity(0))
    return cores + 1 if config.option.numprocesses == "logical" else 2 * cores


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What tests/outside.toml lists is tried a second time when it fails; nothing else is. tests/long.txt is first."""
    long = set(Path(__file__).with_name("long.txt").read_text(encoding="utf-8").splitlines())
    items.sort(key=lambda item: item.nodeid.partition("::")[0] not in long)
    listed = outside()
    for item in items:
        if item.nodeid.partition("[")[0] in listed:
            item.add_marker(pytest.mark.flaky(reruns=1))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Why what was tried again may fail."""
    listed = outside()
    for report in terminalreporter.getreports("rerun"):
        reason = " ".join(listed[report.nodeid.partition("[")[0]].split())
        terminalreporter.write_line(f"tried again: {report.nodeid}: {reason}")
