import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from examples.landshark.lab import Host, Lab
from tests.support.docker import Compose, Engine, build_images, project
from tests.support.requirements import need_root


@dataclass(frozen=True)
class Site:
    """The hosts of the tests: `machine` (10.79.0.1) runs the engine, `laptop` (10.79.0.50) is on its network."""

    engine: Engine
    machine: Host
    laptop: Host

    def story(self) -> str:
        return self.engine.story()


@pytest.fixture(scope="session")
def images() -> None:
    need_root()
    build_images()


@pytest.fixture(scope="module")
def site(images: None) -> Iterator[Site]:
    with Lab("rosrv-engine") as lab:
        machine, laptop = lab.host("machine", "10.79.0.1/24"), lab.host("laptop", "10.79.0.50/24")
        with Engine(machine) as engine:
            yield Site(engine, machine, laptop)


@pytest.fixture(scope="module")
def demo(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Compose]:
    folder = project(tmp_path_factory.mktemp("project"))
    # A clone of another user under umask 077: root of the container reads it with the rights of its owner.
    subprocess.run(["chown", "--recursive", "1000:1000", folder], check=True)
    subprocess.run(["chmod", "--recursive", "go-rwx", folder], check=True)
    compose = site.engine.compose(folder, "demo")
    try:
        compose("--profile", "demo", "up", "--detach", "--no-build")
        yield compose
    finally:
        compose("--profile", "demo", "down", "--volumes", "--timeout", "5")


@pytest.fixture
def alone(site: Site, tmp_path: Path) -> Iterator[Compose]:
    compose = site.engine.compose(project(tmp_path), "alone")
    try:
        compose("up", "--detach", "--no-build")
        compose.wait_healthy()
        yield compose
    finally:
        compose("down", "--volumes", "--timeout", "5")


def without(alone: Compose, right: str) -> None:
    text = yaml.safe_load((alone.directory / "compose.yaml").read_text())
    text["services"]["appliance"]["cap_add"].remove(right)
    text["services"]["appliance"]["restart"] = "no"
    (alone.directory / "compose.yaml").write_text(yaml.safe_dump(text))
    alone("down", "--volumes", "--timeout", "5")
    alone("up", "--detach", "--no-build")
