"""docs/fleet.md, followed command by command, then the collector's backup, restore, upgrade and retention.

Three robots are real appliances, a later one in a container. The others have a real log, a real key, `rosrv fleet
join` and the appliance's pusher.
"""

import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from examples.landshark.lab import Host, Lab
from fleet.tests.support.fleet_site import FleetRobot, push_joined
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.docker import Compose, Engine, build_fleet, project
from tests.support.processes import LIMIT
from tests.support.rosmaster import master_at
from tests.support.sources import ROOT
from tests.support.waiting import eventually

pytestmark = pytest.mark.timeout(2400)  # for the first test: the images are built, and twenty robots join

PAGE = (ROOT / "docs" / "fleet.md").read_text()
_MARKED = re.findall(r"<!-- on: \w+(?:, ([\w ]+))? -->\n```sh\n(.*?)```", PAGE, re.DOTALL)
BLOCKS = [block for name, block in _MARKED if not name]  # the four steps
NAMED = {name: block for name, block in _MARKED if name}
BUILD = "docker compose --file fleet/compose.yaml build"
REAL = 3
_PUSHED = 6 * LIMIT  # a pusher pauses up to 90 s after a failure
# The page's programs on this machine: Docker as the plug-in compose has it, and `ssh` to twenty robots.
DOCKER = """#!/bin/sh
[ "$1" = compose ] || exec {docker} "$@"
shift
exec docker-compose "$@"
"""
SSH = """#!/bin/sh
export ROSRV_STATE={robots}/${{1#root@}}
exec sh -c "$2"
"""
PEER = """
import psycopg, sys
try:
    psycopg.connect(f"host=/run/rosrv-postgres user={sys.argv[1]} dbname=fleet")
    print("connected")
except psycopg.OperationalError as error:
    print(error)
"""


@dataclass(frozen=True)
class Walk:
    folder: Path
    machine: Host
    compose: Compose
    appliances: list[Appliance]
    simulated: list[FleetRobot]
    contained: dict[str, Compose]

    def run(self, block: str, folder: str = "") -> str:
        environment = {
            "PATH": f"{self.folder}/bin:{Path(ROSRV).parent}:{os.environ['PATH']}",
            "HOME": str(self.folder), "DOCKER_HOST": self.compose.engine.address, "COMPOSE_HTTP_TIMEOUT": "120",
        }  # fmt: skip
        known = "".join(line for line in PAGE.splitlines(keepends=True) if line.startswith("rosrv-fleet() {"))
        commands = block.replace(f"{BUILD}\n", "")
        with self.machine.popen(
            ["bash", "-euo", "pipefail", "-c", f"exec 2>&1\n{known}{commands}"],
            cwd=self.folder / folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True,
        ) as process:  # fmt: skip
            said, _ = process.communicate(timeout=1200)
        assert process.returncode == 0, f"{block}\n{said}\n{self.compose.story()}"
        return str(said)

    def fleet(self, *arguments: str) -> str:
        return self.compose.exec("collector", "rosrv-fleet", *arguments, timeout=120).stdout

    def people_and_robots(self) -> tuple[str, str]:
        return re.sub(r"heard \S+", "", self.fleet("robot", "list")), self.fleet("token", "list")

    def wait_healthy(self, service: str) -> None:
        """Poll the state, because the engine keeps too few events to wait for an old one."""
        container = self.compose.container(service)
        eventually(
            lambda: self.compose.engine.inspect(container)["State"]["Health"]["Status"] == "healthy",
            self.compose.story,
            seconds=180,
        )

    def segments(self) -> set[str]:
        find = ("find", "/var/lib/rosrv-fleet/segments", "-type", "f")
        return set(self.compose.exec("collector", *find).stdout.split())

    def proofs(self) -> dict[str, int]:
        found = map(json.loads, self.fleet("verify", "--json").splitlines())
        return {proof["robot"]: proof["last"] for proof in found if proof["ok"] and not proof["missing"]}

    def push(self) -> None:
        for robot in self.simulated:
            self.machine.run(lambda robot=robot: push_joined(robot, self.folder / "robots" / robot.name))  # type: ignore[misc]  # mypy does not infer it

    def everything_is_proven(self) -> None:
        for robot in self.simulated:
            robot.record(10)
        self.push()
        lasts = {robot.name: robot.sealed() for robot in self.simulated}
        for number, appliance in enumerate(self.appliances, 1):
            assert isinstance(appliance.host, Host)
            appliance.host.run(lambda: _work(appliance))  # noqa: B023  it is called here
            exported = map(json.loads, appliance.rosrv("audit", "export").stdout.splitlines())
            last = max(one["sequence"] for one in exported if one["event"] != "checkpoint")
            eventually(lambda: _collected(appliance) >= last, appliance.story, _PUSHED)  # noqa: B023  it is called here
            lasts[f"arm{number}"] = last
        for name, compose in self.contained.items():
            compose.exec("appliance", "rosrv", "policy", "reload")
            exported = map(
                json.loads, compose.exec("appliance", "rosrv", "audit", "export").stdout.splitlines()
            )
            last = max(one["sequence"] for one in exported if one["event"] != "checkpoint")
            eventually(
                lambda: compose.status()["audit"]["collector"]["sequence"] >= last,  # noqa: B023  it is called here
                compose.story,
                _PUSHED,
            )
            lasts[name] = last

        def all_is_proven() -> bool:
            proven = self.proofs()
            return all(proven.get(name, 0) >= last for name, last in lasts.items())

        # A collector that was restored has less than it told the appliances before: they push it again.
        eventually(all_is_proven, lambda: f"{lasts}: {self.proofs()}", _PUSHED)


def _work(appliance: Appliance) -> None:
    with master_at(appliance.master_uri) as master:
        assert master.setParam("/walker", "/value", 1)[0] == 1


def _collected(appliance: Appliance) -> int:
    return int(appliance.status()["audit"]["collector"]["sequence"])


@pytest.fixture(scope="module")
def walk(images: None) -> Iterator[Walk]:
    build_fleet()
    folder = Path(tempfile.mkdtemp(prefix="rosrv-walk-"))
    folder.chmod(0o755)
    try:
        with Lab("rosrv-walk") as lab, Engine(lab.host("machine", "10.0.0.9/24")) as engine:
            walk = _prepared(folder, lab, engine)
            try:
                for block in BLOCKS[:3]:
                    walk.run(block)
                for appliance in walk.appliances:
                    appliance.stop()
                    appliance.start()  # `systemctl restart rosrv`
                yield walk
            finally:
                for appliance in walk.appliances:
                    appliance.stop()
                for robot in walk.simulated:
                    robot.close()
                walk.compose("down", "--volumes", "--timeout", "5", check=False)
    finally:
        shutil.rmtree(folder)


def _prepared(folder: Path, lab: Lab, engine: Engine) -> Walk:
    shutil.copytree(ROOT / "fleet", folder / "fleet")
    programs = {
        "docker": DOCKER.format(docker=shutil.which("docker")), "ssh": SSH.format(robots=folder / "robots"),
        "scp": '#!/bin/sh\n[ "$*" = "root@arm1:incident.zip ." ]\n',  # `ssh` has written the file here
        "systemctl": '#!/bin/sh\n[ "$*" = "restart rosrv" ]\n',
        "rosrv-fleet": f'#!/bin/sh\nPYTHONPATH={ROOT}/fleet/src exec {sys.executable} -m rosrv_fleet "$@"\n',
    }  # fmt: skip
    (folder / "bin").mkdir()
    for name, text in programs.items():
        (folder / "bin" / name).write_text(text)
        (folder / "bin" / name).chmod(0o755)
    (folder / "robots").mkdir()
    appliances = []
    for number in range(1, REAL + 1):
        host = lab.host(f"arm{number}", f"10.0.0.{100 + number}/24")
        appliance = Appliance(host, settings="audit: {checkpoint_seconds: 1}\n")
        appliances.append(appliance.start())
        eventually((appliance.state / "control" / "audit.pub").exists, "the key of the log is pinned")
        (folder / "robots" / f"arm{number}").symlink_to(appliance.state)
    simulated = []
    for number in range(REAL + 1, 21):
        robot = FleetRobot(SimpleNamespace(folder=folder), f"arm{number}", enrolled=False)  # type: ignore[arg-type]  # only its folder is used
        control = folder / "robots" / robot.name / "control"
        control.mkdir(exist_ok=True)
        shutil.copy(robot.folder / "audit.pub.pem", control / "audit.pub")
        simulated.append(robot)
    machine = engine.host
    assert isinstance(machine, Host)
    return Walk(
        folder, machine, engine.compose(folder, "fleet", "fleet/compose.yaml"), appliances, simulated, {}
    )


def test_the_page_leads_to_twenty_robots(walk: Walk) -> None:
    assert len(BLOCKS) == 4
    assert BLOCKS[0].startswith(f"{BUILD}\n")
    names = {f"arm{number}" for number in range(1, 21)}
    listed = [json.loads(line) for line in walk.fleet("robot", "list", "--json").splitlines()]
    assert {robot["name"] for robot in listed} == names
    walk.everything_is_proven()
    said = walk.run(BLOCKS[3])
    assert said.count(" 0 are missing") == 20
    assert re.search(r"^[A-Za-z0-9_-]{43}$", said, re.MULTILINE), said
    eventually(
        lambda: (
            {
                json.loads(line)["robot"]
                for line in walk.fleet("search", "--json", "--limit", "1000").splitlines()
            }
            == names
        ),
        "every robot is found",
    )


def test_the_containers_have_no_rights_and_no_secrets(walk: Walk) -> None:
    for service, user in (("collector", 61030), ("postgres", 61031)):
        walk.wait_healthy(service)
        found = walk.compose.engine.inspect(walk.compose.container(service))
        host = found["HostConfig"]
        assert (host["ReadonlyRootfs"], host["CapDrop"], host["CapAdd"]) == (True, ["ALL"], None)
        assert json.dumps(host["SecurityOpt"]) == '["no-new-privileges:true"]'
        status = Path(f"/proc/{found['State']['Pid']}/status").read_text()
        assert f"Uid:\t{user}\t{user}\t{user}\t{user}" in status
        assert re.findall(r"Cap(?:Prm|Eff|Bnd|Amb):\t(\w+)", status) == ["0" * 16] * 4
        assert not re.search(r"passw|secret|token|private key", json.dumps(found["Config"]), re.IGNORECASE)
        assert walk.compose.exec(service, "sh", "-c", "touch /etc/x", check=False).returncode != 0
        find = ("find", "/", "-xdev", "-type", "f", "-perm", "/6000")
        root = ("run", "--rm", "--user", "0", "--entrypoint", find[0], found["Config"]["Image"])
        assert walk.compose.engine.docker(*root, *find[1:]).stdout == ""
    assert (
        walk.compose.engine.inspect(walk.compose.container("postgres"))["HostConfig"]["NetworkMode"] == "none"
    )


def test_only_the_collectors_user_reaches_the_database(walk: Walk) -> None:
    def tried(user: str, role: str) -> str:
        container = walk.compose.container("collector")
        python = ("/opt/fleet/bin/python", "-P", "-c", PEER, role)
        return walk.compose.engine.docker("exec", "--user", user, container, *python).stdout

    assert tried("61030", "fleet") == "connected\n"
    for user, role in (("0", "fleet"), ("61099", "fleet"), ("61030", "postgres"), ("0", "postgres")):
        assert "eer authentication failed" in tried(user, role) or "no pg_hba.conf entry" in tried(user, role)


def test_an_appliance_in_a_container_joins(walk: Walk) -> None:
    folder = walk.folder / "arm21"
    folder.mkdir()
    compose = walk.compose.engine.compose(project(folder), folder.name)
    often = {"services": {"appliance": {"environment": {"ROSRV_AUDIT__CHECKPOINT_SECONDS": "1"}}}}
    (folder / "compose.override.yaml").write_text(json.dumps(often))
    compose("up", "--detach", "--no-build", "appliance")
    compose.wait_healthy()
    invite = "rosrv-fleet robot invite arm-1 --group site-a/arms > arm-1.json"
    assert invite in PAGE
    walk.run(invite.replace("arm-1", "arm21"))
    (walk.folder / "arm21.json").rename(folder / "arm7.json")
    said = walk.run(NAMED["joins"], folder.name)
    assert "arm21 is enrolled at https://10.0.0.9:8444: certificate SHA-256 " in said
    compose.wait_healthy()
    walk.contained["arm21"] = compose
    walk.everything_is_proven()


def test_a_bundle_reaches_a_robot_in_a_container(walk: Walk) -> None:
    arms, compose = walk.folder / "arms", walk.contained["arm21"]
    arms.mkdir()
    shutil.copy(ROOT / "policies" / "containers.ini", arms / "policy.ini")
    with (arms / "policy.ini").open("a") as policy:
        policy.write("# of the bundle\n")
    (arms / "hosts.yaml").write_text("hosts: []\n")
    (walk.folder / "passphrase").write_text("a passphrase for tests\n")
    signs = re.sub(r" --ring \S+", "", NAMED["signs"])  # its robots are not enrolled here
    walk.run(signs.replace("--repository bundles", "--repository bundles --passphrase-file passphrase"))
    walk.run(NAMED["gives"])
    (line,) = re.findall(r"^(bundles: {.*\n)", PAGE, re.MULTILINE)
    with (walk.folder / "fleet" / "fleet.yaml").open("a") as config:
        config.write(line)
    walk.run(NAMED["restarts"])
    (text,) = re.findall(r"write this file `compose.override.yaml`.*?```yaml\n(.*?)```", PAGE, re.DOTALL)
    override = yaml.safe_load(text)
    override["services"]["appliance"]["environment"] |= {
        "ROSRV_AUDIT__CHECKPOINT_SECONDS": "1", "ROSRV_FLEET__BUNDLES__CONFIRM_SECONDS": "2",
    }  # fmt: skip
    (compose.directory / "compose.override.yaml").write_text(yaml.safe_dump(override))
    shutil.copy(walk.folder / "bundles" / "root.json", compose.directory)
    compose("up", "--detach", "--no-build", "appliance")
    walk.wait_healthy("collector")
    walk.run(NAMED["rolls out"].replace("1.tar\n", "1.tar --healthy 0s\n"))

    def rolled_out() -> bool:
        status = "command rosrv-fleet rollout status --json"
        (group,) = json.loads(walk.run(f"{_connection('rolls out')}{status}"))["groups"]
        return bool(group["rollout"]["state"] == "done" and group["conditions"]["in force"] == 1)

    eventually(rolled_out, compose.story, seconds=120)
    compose("restart", "appliance")
    compose.wait_healthy()
    assert "of the bundle" in compose.exec("appliance", "rosrv", "policy", "show").stdout
    assert compose.status()["bundles"]["in_force"] == "site-a/arms/1.tar"
    walk.everything_is_proven()


def test_the_collector_keeps_evidence(walk: Walk) -> None:
    block = NAMED["keeps evidence"].replace("arm7", "arm1").replace("1879f3c2a4b5d6e7f012", "--since 1h")
    adds, get = block.split("command rosrv-fleet evidence get ")
    (name,) = re.findall(r"^([0-9a-f]{64}) is stored: evidence of arm1", walk.run(adds), re.MULTILINE)
    walk.run(f"{_connection('keeps evidence')}command rosrv-fleet evidence get {get.replace('5d0f…', name)}")
    assert (walk.folder / "copy.zip").read_bytes() == (walk.folder / "incident.zip").read_bytes()


def _connection(block: str) -> str:
    (export,) = re.findall(r"^export .*\n", NAMED[block], re.MULTILINE)
    return str(export)


def test_a_robot_is_added_with_its_files(walk: Walk) -> None:
    robot = FleetRobot(SimpleNamespace(folder=walk.folder), "arm22", enrolled=False)  # type: ignore[arg-type]  # only its folder is used
    robot.close()
    shutil.copy(robot.folder / "audit.pub.pem", walk.folder / "audit.pub")
    shutil.copy(robot.certificates.certificate, walk.folder / "robot.pem")
    said = walk.run(NAMED["adds"].replace("arm7", "arm22"))
    assert f"arm22 is enrolled: log key {robot.public.hex()}" in said


def test_prometheus_reads_the_metrics(walk: Walk) -> None:
    said = walk.run(NAMED["metrics"])
    assert 'rosrv_fleet_gaps{robot="arm1"} 0' in said


def test_a_backup_restores_the_collector(walk: Walk) -> None:
    before = walk.people_and_robots()
    walk.run(NAMED["backs up"])
    assert stat.S_IMODE((walk.folder / "collector.tar").stat().st_mode) == 0o600
    walk.everything_is_proven()
    segments = walk.segments()
    walk.compose("down", "--volumes", "--timeout", "60")
    (walk.folder / "fleet" / "fleet.yaml").unlink()
    walk.run(NAMED["restores"])
    for service in ("postgres", "collector"):
        walk.wait_healthy(service)
    assert walk.people_and_robots() == before
    walk.everything_is_proven()
    assert walk.segments() >= segments
    search = ("search", "--json", "--limit", "1000", "--robot", "arm20")
    eventually(
        lambda: len(walk.fleet(*search).splitlines()) == walk.simulated[-1].sealed(), "every record is found"
    )


def test_both_containers_are_killed(walk: Walk) -> None:
    walk.everything_is_proven()
    before = walk.proofs()
    for service in ("postgres", "collector"):
        container = walk.compose.container(service)
        state = walk.compose.engine.inspect(container)["State"]
        os.kill(state["Pid"], signal.SIGKILL)
        eventually(
            lambda: walk.compose.engine.inspect(container)["State"]["StartedAt"] != state["StartedAt"],  # noqa: B023  it is called here
            walk.compose.story,
        )
    for service in ("postgres", "collector"):
        walk.wait_healthy(service)
    after = walk.proofs()
    assert all(after[name] >= last for name, last in before.items())
    walk.everything_is_proven()


def test_a_new_image_continues_with_the_volumes(walk: Walk) -> None:
    walk.fleet("token", "add", "upgrader")
    images = {
        service: f"rosrv/{name}" for service, name in (("collector", "fleet"), ("postgres", "fleet-postgres"))
    }
    earlier = {service: walk.compose.container(service) for service in images}
    for image in images.values():
        walk.compose.engine.docker("build", "--tag", image, "-", text=f"FROM {image}\nLABEL upgraded=yes\n")
    walk.run(NAMED["upgrades"])
    for service in images:
        walk.wait_healthy(service)
        container = walk.compose.container(service)
        assert container != earlier[service]
        assert walk.compose.engine.inspect(container)["Config"]["Labels"]["upgraded"] == "yes"
    assert "upgrader" in walk.fleet("token", "list")
    walk.everything_is_proven()
    found = {
        json.loads(line)["robot"] for line in walk.fleet("search", "--json", "--limit", "1000").splitlines()
    }
    assert len(found) >= 20


def _of_arm4(walk: Walk) -> set[str]:
    return {name for name in walk.segments() if "/segments/arm4/" in name}


def test_retention_removes_old_segments(walk: Walk) -> None:
    (setting,) = re.findall(r"^(retention: .*\n)", PAGE, re.MULTILINE)
    old = "ls /var/lib/rosrv-fleet/segments/arm4/*/*/*.gz | head -2 | xargs touch --date '-731 days'"
    walk.compose.exec("collector", "sh", "-c", old)
    with (walk.folder / "fleet" / "fleet.yaml").open("a") as config:
        config.write(setting)
    before = _of_arm4(walk)
    walk.run(NAMED["restarts"])
    eventually(lambda: len(before - _of_arm4(walk)) == 2, walk.compose.story)
    said = walk.fleet("verify", "arm4")
    assert "were removed by the collector (retention.segment_days: 730)" in said
    assert set(walk.proofs()) >= {f"arm{number}" for number in range(1, 21)}


def test_a_robot_in_a_container_leaves(walk: Walk) -> None:
    compose = walk.contained.pop("arm21")
    (compose.directory / "compose.override.yaml").unlink()
    compose("up", "--detach", "--no-build", "appliance")
    compose.wait_healthy()
    walk.run(NAMED["leaves"], "arm21")
    compose.wait_healthy()
    assert compose.status()["audit"].get("collector") is None
    assert "rosrv-fleet robot remove arm7" in PAGE
    walk.fleet("robot", "remove", "arm21")
    listed = [json.loads(line) for line in walk.fleet("robot", "list", "--json").splitlines()]
    assert {robot["name"] for robot in listed if robot["state"] == "removed"} == {"arm21"}
    assert walk.proofs()["arm21"] > 0


def test_the_image_has_no_key_and_no_tool_to_fetch_programs(walk: Walk) -> None:
    options = ("run", "--rm", "--entrypoint", "sh", "rosrv/fleet", "-c")
    tools = "command -v pip pip3 gcc curl wget git; ls /opt/fleet/bin; ls -A /var/lib/rosrv-fleet"
    listed = walk.compose.engine.docker(*options, tools, check=False).stdout.split()
    assert "rosrv-fleet" in listed
    assert not {"pip", "gcc", "curl", "wget", "git", "server.key"} & {Path(one).name for one in listed}
    assert stat.S_IMODE((ROOT / "fleet/postgres/start").stat().st_mode) & 0o111
