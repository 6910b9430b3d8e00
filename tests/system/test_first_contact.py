"""A checkout runs where newcomers put it: in a home of mode 0700, under any umask, by any path, as a user of sudo.

The checkouts share the installed packages of this one by hard links, with the permissions that `scripts/setup` gives.
"""

import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import distribution
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

from examples.landshark.lab import Lab
from tests.support.appliance import OPEN_POLICY
from tests.support.command import ROSRV, rosrv
from tests.support.nodes import need_ros
from tests.support.own_namespace import own_namespace
from tests.support.processes import LIMIT, Process, ThisMachine
from tests.support.requirements import need_root
from tests.support.waiting import eventually

ROOT: Final = Path(__file__).parents[2]
PACKAGES: Final = Path(
    *Path(pytest.__file__).relative_to(ROOT / ".venv").parts[:3]
)  # lib/python3.11/site-packages
USER: Final = 61098  # a user of the machine, who owns the home and the checkout
DEMO_SECONDS: Final = 600  # for one that hangs


@dataclass(frozen=True)
class Way:
    owner: int = 0
    mode: int = 0o700
    umask: int = 0o022
    name: str = "rosrv"
    by_link: bool = False


WAYS: Final = {
    "an open folder": Way(mode=0o755), "the home of root": Way(), "the home of a sudo user": Way(owner=USER),
    "umask 077": Way(mode=0o755, umask=0o077), "umask 027": Way(mode=0o755, umask=0o027),
    "a name with spaces": Way(name="my robots/the appliance"), "a symbolic link": Way(by_link=True),
    "all at once": Way(owner=USER, umask=0o077, name="my robots/the appliance", by_link=True),
}  # fmt: skip


@dataclass(frozen=True)
class Checkout:
    home: Path
    path: Path

    def command(self, *arguments: str) -> list[str]:
        return [str(self.path / ".venv" / "bin" / "python"), "-m", "appliance.cli.main", *arguments]

    def run(self, *arguments: str, seconds: float = 2 * LIMIT) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            self.command(*arguments), cwd=self.path, env=self.environment, capture_output=True, text=True,
            timeout=seconds, check=False,
        )  # fmt: skip

    @property
    def environment(self) -> dict[str, str]:
        return {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": str(self.home), "PYTHONUNBUFFERED": "1"}


@pytest.fixture
def checkout(request: pytest.FixtureRequest) -> Iterator[Checkout]:
    need_root()
    need_ros()
    way = WAYS[request.param]
    above = Path(tempfile.mkdtemp(prefix="rosrv-first-"))
    above.chmod(0o755)
    try:
        home = above / "home"
        home.mkdir()
        os.chown(home, way.owner, way.owner)
        home.chmod(way.mode)
        place = home / way.name
        clone(place, way)
        share_packages(place)
        if way.by_link:
            (home / "link").symlink_to(place)
            place = home / "link"
        yield Checkout(home, place)
    finally:
        shutil.rmtree(above)


def clone(path: Path, way: Way) -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    files = subprocess.run(
        ["tar", "--null", "--files-from=-", "--create", "--mode=u+w,go+rX"],
        cwd=ROOT,
        input=listed,
        capture_output=True,
        check=True,
    ).stdout
    script = 'mkdir -p "$0" && tar --extract --no-same-permissions --no-same-owner --directory "$0"'
    given = {"user": way.owner, "group": way.owner, "umask": way.umask, "extra_groups": []}
    subprocess.run(["sh", "-c", script, str(path)], input=files, check=True, cwd="/", **given)  # type: ignore[call-overload]  # the options depend on nothing


def share_packages(path: Path) -> None:
    for module in (ROOT / "appliance/relay/transport").glob("pump*.so"):
        shutil.copy(module, path / module.relative_to(ROOT))
    command = ["/usr/bin/python3", "-m", "venv", "--without-pip", str(path / ".venv")]
    subprocess.run(command, check=True)
    packages = path / ".venv" / PACKAGES
    for name in re.findall(r"^([a-z0-9.-]+)==", (ROOT / "requirements.lock").read_text(), re.MULTILINE):
        for file in distribution(name).files or ():
            if ".." not in file.parts:  # a program of the package
                (packages / file).parent.mkdir(parents=True, exist_ok=True)
                link_or_copy(ROOT / ".venv" / PACKAGES / file, packages / file)
    (packages / "rosrv.pth").write_text(f"{path}\n")


def link_or_copy(source: Path, target: Path) -> None:
    try:
        target.hardlink_to(source)
    except OSError:
        shutil.copy(source, target)


@pytest.mark.parametrize("checkout", WAYS, indirect=True)
def test_the_appliance_runs_from_a_checkout(checkout: Checkout) -> None:
    files = {
        "robot.ini": OPEN_POLICY,
        "monitors/m.rv": (ROOT / "monitors" / "safe_zone.rv").read_text(),
        "hosts.yaml": "hosts: [{name: ocu-1}]\n",
    }
    shutil.copytree(ROOT / "monitors" / "msg", checkout.home / "monitors" / "msg")
    for name, text in files.items():
        (checkout.home / name).write_text(text)
        (checkout.home / name).chmod(0o600)
    (checkout.home / "monitors").chmod(0o700)
    state = str(checkout.home / "state")
    policy = checkout.home / "robot.ini"
    assert checkout.run("policy", "check", str(policy)).returncode == 0
    config = checkout.home / "appliance.yaml"
    config.write_text(
        f"policy: {policy}\nmonitors: {checkout.home / 'monitors'}\nhosts: {checkout.home / 'hosts.yaml'}\n"
        f"state: {state}\nisolation: container\nenable: all\nlisten: 10.85.0.2:11311\n"
    )
    config.chmod(0o600)
    with Lab("rosrv-first") as lab:
        machine = lab.host("machine", "10.85.0.2/24")
        command = checkout.command("up", "--json", "--config", str(config))
        with Process(
            machine, command, env=checkout.environment, label="rosrv up", cwd=str(checkout.path)
        ) as up:
            up.wait_for(event="ready", timeout=2 * LIMIT)
            new = checkout.home / "new.ini"
            new.write_text(f"# replaced\n{OPEN_POLICY}")
            new.chmod(0o600)
            new.rename(policy)
            reloaded = checkout.run("policy", "reload", "--state", state)
            assert reloaded.returncode == 0, reloaded.stderr + up.story()
            assert "# replaced" in checkout.run("policy", "show", "--state", state).stdout
            assert "safeZone" in checkout.run("monitor", "list", "--state", state).stdout
            assert "ocu-1" in checkout.run("host", "list", "--state", state).stdout

            def status() -> dict[str, Any]:
                shown = checkout.run("status", "--json", "--state", state)
                found: dict[str, Any] = json.loads(shown.stdout)
                return found

            eventually(
                lambda: all(
                    process["sandbox"] and not process["restarts"]
                    for process in status()["processes"]
                    if process["role"] != "supervisor"
                ),
                up.story,
            )


@pytest.mark.parametrize("checkout", ["the home of root"], indirect=True)
def test_the_default_isolation_runs_from_a_home(checkout: Checkout) -> None:
    policy = checkout.home / "robot.ini"
    policy.write_text(OPEN_POLICY)
    state = checkout.home / "state"
    options = ("--policy", str(policy), "--state", str(state), "--json")
    with Lab("rosrv-first") as lab, own_namespace():
        machine = lab.host("machine", "10.85.0.2/24")
        command = checkout.command("up", *options)
        with Process(
            machine, command, env=checkout.environment, label="rosrv up", cwd=str(checkout.path)
        ) as up:
            up.wait_for(event="ready", timeout=2 * LIMIT)
            shown = checkout.run("status", "--state", str(state))
            assert "probe passed" in shown.stdout, shown.stdout + up.story()


def test_a_container_reads_what_only_its_owner_may() -> None:
    need_root()
    given = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]["appliance"]["cap_add"]
    rights = ",".join(f"+{name.lower()}" for name in given)
    above = Path(tempfile.mkdtemp(prefix="rosrv-first-"))
    above.chmod(0o755)
    shutil.copytree(ROOT / "monitors", above / "monitors")
    for folder, name, text in (
        ("policies", "robot.ini", OPEN_POLICY),
        ("ipsec", "hosts.yaml", "hosts: [{name: ocu-1}]\n"),
    ):
        (above / folder).mkdir()
        (above / folder / name).write_text(text)
    for path in above.rglob("*"):
        os.chown(path, USER, USER)
        path.chmod(0o700 if path.is_dir() else 0o600)
    command = ["setpriv", f"--bounding-set=-all,{rights}", ROSRV, "up", "--json", "--isolation", "container"]
    command += ["--policy", str(above / "policies" / "robot.ini"), "--monitors", str(above / "monitors")]
    command += ["--state", str(above / "state"), "--listen", "10.85.0.2:11311"]
    check = [*command[:2], ROSRV, "policy", "check", str(above / "policies" / "robot.ini")]
    environment = os.environ | {"ROSRV_HOSTS": str(above / "ipsec" / "hosts.yaml")}
    try:
        subprocess.run(check, check=True)
        with Lab("rosrv-first") as lab:
            machine = lab.host("machine", "10.85.0.2/24")
            with Process(machine, command, env=environment, label="rosrv up") as up:
                up.wait_for(event="ready", timeout=2 * LIMIT)
                for verbs, shown in ((("policy", "reload"), ""), (("host", "list"), "ocu-1")):
                    done = rosrv(*verbs, "--state", str(above / "state"))
                    assert done.returncode == 0, done.stderr + up.story()
                    assert shown in done.stdout
    finally:
        shutil.rmtree(above)


@pytest.mark.parametrize("checkout", ["the home of root", "all at once"], indirect=True)
def test_the_demonstration_runs_from_a_checkout(checkout: Checkout) -> None:
    with Process(
        ThisMachine(),
        checkout.command("demo"),
        env=checkout.environment,
        label="rosrv demo",
        cwd=str(checkout.path),
    ) as demo:
        assert demo.wait(timeout=DEMO_SECONDS) == 0, demo.story()
        assert re.search(r"(\d+) of \1 results as expected", demo.output())
