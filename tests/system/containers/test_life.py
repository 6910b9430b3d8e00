import json
import ssl
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.support.docker import APPLIANCE, Compose, project
from tests.support.waiting import allowed, eventually
from tests.system.containers.conftest import Site, without

pytestmark = pytest.mark.timeout(1500)  # for the first test: the images are built

STOP_SECONDS = 5.0


@pytest.fixture
def talking(site: Site, tmp_path: Path) -> Iterator[Compose]:
    compose = site.engine.compose(project(tmp_path), "life")
    try:
        compose("--profile", "demo", "up", "--detach", "--no-build", "landshark", "ocu")
        compose.wait_for_log("ocu", '"fired"', timeout=120)
        yield compose
    finally:
        compose("--profile", "demo", "down", "--volumes", "--timeout", "5")


def drives_on(compose: Compose) -> None:
    moment = compose.engine.docker("info", "--format", "{{.SystemTime}}").stdout.strip()
    compose.wait_for_log("ocu", '"position"', since=moment, timeout=90)
    assert compose.engine.inspect(compose.container("ocu"))["RestartCount"] == 0


def test_a_stop_is_clean_and_quick(alone: Compose) -> None:
    """Processes that need more than 3.3 s are killed. On an idle machine, a stop takes less than five seconds.

    As this limit does not grow with the load of the machine, only one stop of three must need no kill.
    """
    assert any("SIGKILL" not in log_of_a_stop(alone) for _attempt in range(3)), alone.story()


def log_of_a_stop(alone: Compose) -> str:
    alone("start")
    alone.wait_healthy()
    container = alone.container("appliance")
    eventually(
        lambda: all(row["sandbox"] for row in alone.status()["processes"] if row["role"] != "supervisor"),
        alone.story,
    )
    begun = alone.engine.inspect(container)["State"]["StartedAt"]
    alone("stop")
    state = alone.engine.inspect(container)["State"]
    assert state["ExitCode"] == 0, alone.story()
    now = alone.engine.docker("info", "--format", "{{.SystemTime}}").stdout.strip()
    options = ("--since", begun, "--until", now, "--filter", f"container={container}")
    lines = alone.engine.docker(
        "events", *options, "--format", "{{.Status}} {{.TimeNano}}"
    ).stdout.splitlines()
    moments = {name: int(moment) / 1e9 for name, _, moment in (line.rpartition(" ") for line in lines)}
    assert moments["die"] - moments["kill"] < allowed(STOP_SECONDS)
    printed = alone.engine.docker("logs", "--since", begun, container)
    log = printed.stdout + printed.stderr
    assert "process started" in log
    return log


def test_nodes_go_on_after_stop_start_and_kill(talking: Compose) -> None:
    container = talking.container("appliance")
    talking("stop", "appliance")
    talking("start", "appliance")
    talking.wait_healthy()
    drives_on(talking)
    talking.engine.docker("kill", "--signal", "KILL", container)
    talking("start", "appliance")
    talking.wait_healthy()
    drives_on(talking)
    verified = talking.exec("appliance", "rosrv", "audit", "verify", check=False)
    assert verified.returncode == 0, verified.stdout + verified.stderr


def test_a_recreated_container_keeps_its_certificate(site: Site, alone: Compose) -> None:
    def certificate() -> str:
        return site.machine.run(lambda: ssl.get_server_certificate(("127.0.0.1", 8443), timeout=30))

    alone.wait_healthy()
    before, container = certificate(), alone.container("appliance")
    alone("up", "--detach", "--no-build", "--force-recreate", "appliance")
    alone.wait_healthy()
    assert alone.container("appliance") != container
    assert certificate() == before
    assert container[:12] not in ssl.PEM_cert_to_DER_cert(before).decode("latin-1")


def test_the_robot_may_restart(talking: Compose) -> None:
    talking("kill", "landshark")
    talking("--profile", "demo", "up", "--detach", "--no-build", "landshark")
    drives_on(talking)
    talking("kill", "appliance", "landshark")
    talking("--profile", "demo", "up", "--detach", "--no-build", "landshark")
    talking.wait_healthy()
    drives_on(talking)


def test_down_leaves_nothing(site: Site, tmp_path: Path) -> None:
    compose = site.engine.compose(project(tmp_path), "gone")

    def machine() -> str:
        def look() -> str:
            commands = ("ip -brief link", "ip route", "iptables-save -t filter", "iptables-save -t nat")
            said = [_said(*command.split()) for command in commands]
            lines = [line.partition(" [")[0] for one in said for line in one.splitlines()]
            return "\n".join(line for line in lines if not line.startswith("#"))

        return site.machine.run(look) + site.engine.docker("volume", "ls", "--quiet").stdout

    before = machine()
    for end in ("running", "killed"):
        compose("up", "--detach", "--no-build")
        assert machine() != before
        if end == "killed":
            compose("kill")
        compose("down", "--volumes", "--timeout", "5")
        assert machine() == before


def test_backup_and_restore_as_documented(alone: Compose, tmp_path: Path) -> None:
    container, entry = alone.container("appliance"), ("--entrypoint", "rosrv", APPLIANCE)
    folder = ("--volume", f"{tmp_path}:/backup")
    backup = ("--cap-add", "DAC_OVERRIDE", "--volumes-from", container, *folder, *entry, "backup")
    state = ("/backup/rosrv.tar.gz", "--state", "/var/lib/rosrv")
    alone.engine.docker("run", "--rm", *backup, *state)
    before = alone.audit("--oldest-first")[0]["id"]
    alone("down", "--volumes", "--timeout", "5")
    alone("up", "--no-start", "--no-build")
    alone.engine.docker(
        "run", "--rm", "--volume", "alone_state:/var/lib/rosrv", *folder, *entry, "restore", *state
    )
    alone("start")
    alone.wait_healthy()
    assert alone.audit("--oldest-first")[0]["id"] == before
    verified = alone.exec("appliance", "rosrv", "audit", "verify", check=False)
    assert verified.returncode == 0, verified.stdout + verified.stderr


def _said(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def rights(compose: Compose) -> list[str]:
    text = yaml.safe_load((compose.directory / "compose.yaml").read_text())
    granted: list[str] = text["services"]["appliance"]["cap_add"]
    return granted


@pytest.mark.parametrize("right", ["NET_ADMIN", "SETUID", "SETGID", "CHOWN"])
def test_no_start_without_a_required_capability(right: str, site: Site) -> None:
    given = [f"--cap-add={one}" for one in ("NET_ADMIN", "SETUID", "SETGID", "CHOWN", "KILL") if one != right]
    done = site.engine.docker(
        "run",
        "--rm",
        "--cap-drop",
        "ALL",
        *given,
        "--env",
        "ROSRV_API=off",
        APPLIANCE,
        check=False,
        timeout=90,
    )
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1].startswith("rosrv: ")


def hung_relay_ends(compose: Compose, seconds: float) -> bool:
    pid = next(row["pid"] for row in compose.status()["processes"] if row["role"] == "relay")
    compose(
        "exec", "-T", "--user", "rosrv-relay", "appliance", "python", "-c", f"import os; os.kill({pid}, 19)"
    )
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        rows = [row for row in compose.status()["processes"] if row["role"] == "relay"]
        if any(row["pid"] != pid for row in rows):
            return True
    return False


def test_a_hanging_process_is_ended_with_the_kill_capability(alone: Compose) -> None:
    assert hung_relay_ends(alone, 30)
    without(alone, "KILL")
    alone.wait_healthy()
    assert not hung_relay_ends(alone, 15)


def test_no_other_capability_is_given(alone: Compose) -> None:
    proven = {
        "NET_ADMIN",
        "SETUID",
        "SETGID",
        "CHOWN",
        "KILL",
        "NET_BIND_SERVICE",
    }  # the last: test_tunnel.py
    assert set(rights(alone)) == proven
    settings = alone.engine.inspect(alone.container("appliance"))["HostConfig"]
    assert settings["CapDrop"] == ["ALL"]
    assert {one.removeprefix("CAP_") for one in settings["CapAdd"]} == proven
    assert settings["ReadonlyRootfs"]
    assert not settings["Privileged"]
    assert settings["Memory"] == settings["MemorySwap"] == 2 << 30
    assert settings["PidsLimit"] == 512
    assert json.dumps(settings["SecurityOpt"]) == '["no-new-privileges:true"]'
