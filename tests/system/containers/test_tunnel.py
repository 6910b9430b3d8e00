import os
import subprocess
from pathlib import Path

import pytest

from tests.support.docker import Compose
from tests.support.nodes import RosSession
from tests.support.tunnels import JoinedHost, need_strongswan
from tests.support.waiting import eventually
from tests.system.containers.conftest import Site, without

pytestmark = pytest.mark.timeout(1500)  # for the first test: the images are built

MACHINE = "10.79.0.1"
POLICY = """\
[Groups]
laptop = host:laptop
[Nodes]
default = laptop
[Publishers]
default = laptop
[Subscribers]
default = laptop
[Commands]
default = laptop
"""
ENROL = ("rosrv", "host", "add", "laptop", "--appliance", MACHINE, "--output", "/tmp/laptop.tar.gz")


def enrolled_as_documented(alone: Compose, kit: Path) -> Path:
    """Enrol a host as in docs/install.md: endpoint in `.env`, and the kit from standard output."""
    (alone.directory / ".env").write_text(f"ROSRV_ENDPOINT={MACHINE}\n")
    alone("up", "--detach", "--no-build")
    alone.wait_healthy()
    command = ["docker-compose", "--project-name", alone.project, "exec", "-T", "appliance"]
    with kit.open("wb") as file:
        subprocess.run(
            [*command, "rosrv", "host", "add", "laptop", "--output", "-"],
            stdin=subprocess.DEVNULL,
            stdout=file,
            cwd=alone.directory,
            env=os.environ | {"DOCKER_HOST": alone.engine.address},
            timeout=120,
            check=True,
        )
    return kit


def test_a_laptop_joins_publishes_and_is_revoked(site: Site, alone: Compose, tmp_path: Path) -> None:
    need_strongswan()
    kit = enrolled_as_documented(alone, tmp_path / "laptop.tar.gz")
    (alone.directory / "policies" / "containers.ini").write_text(POLICY)
    (alone.directory / "policies" / "containers.ini.tests.yaml").unlink()
    alone.exec("appliance", "rosrv", "policy", "reload")
    with JoinedHost(site.laptop, kit, tmp_path / "laptop") as laptop:
        laptop.wait_until_up()
        with RosSession(laptop.master, tmp_path, laptop) as ros:
            listener = ros.listener("rospy", "/chatter", name="listener")
            talker = ros.talker("rospy", "/chatter", name="talker")
            listener.wait_for(event="received")
            registered = eventually(
                lambda: alone.audit("--event", "registered", "--caller", "/talker"), alone.story
            )
            assert {record["host"] for record in registered} == {laptop.address}
            nowhere_to_write = alone.exec("appliance", "rosrv", "host", "kit", "laptop", check=False)
            assert nowhere_to_write.returncode == 2
            assert (
                "Read-only file system; name another: --output FILE, or --output - > FILE"
                in nowhere_to_write.stderr
            )
            assert not alone.audit("--event", "host renewed"), "its certificate and its tunnel were kept"
            assert "up" in alone.exec("appliance", "rosrv", "host", "list").stdout
            alone.exec("appliance", "rosrv", "host", "revoke", "laptop")
            eventually(lambda: alone.audit("--event", "host revoked"), alone.story)
            assert "revoked" in alone.exec("appliance", "rosrv", "host", "list").stdout
            cut = listener.mark()
            with pytest.raises(AssertionError, match="5 s passed"):
                listener.wait_for(event="received", since=cut + 20, timeout=5)
            for node in (listener, talker):
                node.kill()  # it cannot close the tunnel with a message


def test_no_token_is_made_that_no_host_can_use(alone: Compose) -> None:
    add = ("rosrv", "host", "add", "laptop", "--appliance", MACHINE)
    done = alone.exec("appliance", *add, "--token", "--output", "-", check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert "publish port 8443 of the container" in done.stderr
    assert "laptop" not in alone.exec("appliance", "rosrv", "host", "list").stdout


def test_low_ports_need_the_capability(alone: Compose) -> None:
    without(alone, "NET_BIND_SERVICE")
    alone.wait_healthy()
    done = alone.exec("appliance", *ENROL, check=False)
    assert "charon has not loaded it yet" in done.stderr
    alone.wait_for_log("appliance", "charon cannot be started")
