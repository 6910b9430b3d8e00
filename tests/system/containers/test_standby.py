from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.docker import Compose, project
from tests.support.waiting import eventually
from tests.system.containers.conftest import Site

pytestmark = pytest.mark.timeout(1500)  # for the first test: the images are built
_FILE = "compose.standby.yaml"


@pytest.fixture
def pair(site: Site, tmp_path: Path) -> Iterator[Compose]:
    compose = site.engine.compose(project(tmp_path), "pair", _FILE)
    try:
        compose("up", "--detach", "--no-build")
        for name in ("a", "b"):
            compose.wait_healthy(name)
        yield compose
    finally:
        compose("down", "--volumes", "--timeout", "5")


def test_the_standby_takes_over_from_a_killed_container(pair: Compose) -> None:
    pair.wait_for_log("ocu", '"position"', timeout=180)
    eventually(lambda: pair.row("standby", "status", service="a")["other"]["in_sync"], pair.story)
    nodes = {name: pair.container(name) for name in ("landshark", "ocu")}
    pair("kill", "a")
    pair.wait_for_log("ocu", '"regained"', timeout=120)
    assert pair.row("standby", "status", service="b")["role"] == "active"
    assert {name: pair.container(name) for name in nodes} == nodes
