"""The Ansible role and the cloud-init example, run by their own programs in a Debian made for the test.

A program that logs its calls takes the place of `systemctl`, and `rosrv selftest` is only logged.
"""

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.debian_base import ROOT, make_base

pytestmark = pytest.mark.timeout(1200)  # the Debian is made


@pytest.fixture(scope="module")
def debian(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    tree = make_base(
        tmp_path_factory.mktemp("debian") / "tree", ["ansible-core", "cloud-init", "python3-apt"]
    )
    shutil.copytree(ROOT / "examples", tree / "examples")
    yield tree
    shutil.rmtree(tree)


def run(tree: Path, *command: str) -> str:
    done = tried(tree, *command)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def tried(tree: Path, *command: str, **environment: str) -> subprocess.CompletedProcess[str]:
    script = """
        tree=$1 root=$2; shift 2
        mount -t proc proc "$tree/proc"
        mkdir -p "$tree$root"
        mount --bind "$root" "$tree$root"
        mount -o remount,bind,ro "$tree$root"
        exec chroot "$tree" "$@"
    """
    inside = [
        "unshare", "--mount", "--propagation", "private", "sh", "-euc", script, "sh", str(tree), str(ROOT),
    ]  # fmt: skip
    return subprocess.run(
        [*inside, *command],
        capture_output=True,
        text=True,
        env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "LC_ALL": "C.UTF-8"} | environment,
        check=False,
    )


def test_ansible_accepts_the_role(debian: Path) -> None:
    said = run(debian, "ansible-playbook", "--syntax-check", "-i", "robots,", "/examples/ansible/site.yml")
    assert "playbook: /examples/ansible/site.yml" in said
    listed = run(debian, "ansible-playbook", "--list-tasks", "-i", "robots,", "/examples/ansible/site.yml")
    assert listed.count("rosrv :") >= 7


_SYSTEMCTL = """\
#!/bin/sh
case $1 in
show) [ -e /srv/active ] && state=active || state=inactive
      printf 'Id=rosrv.service\\nLoadState=loaded\\nActiveState=%s\\n' "$state"; exit ;;
is-enabled) [ -e /srv/enabled ] && echo enabled && exit; echo disabled; exit 1 ;;
enable) touch /srv/enabled ;;
start | restart) touch /srv/active ;;
esac
echo "systemctl $*" >> /srv/asked
"""
_ROSRV = f"""\
#!/bin/sh
echo "rosrv $1" >> /srv/asked
[ "$1" = selftest ] || exec {ROOT}/.venv/bin/rosrv "$@"
"""
_CONTROL = """\
Package: rosrv
Version: 0.2.0
Architecture: all
Maintainer: nobody <nobody@example.org>
Description: a stand-in
"""
_POLICY = "[Groups]\nvehicle = 10.0.0.5\n[Nodes]\ndefault = vehicle\n"


class Robot:
    def __init__(self, tree: Path) -> None:
        self.tree = tree
        package = tree / "srv/package"
        self._write(package / "DEBIAN/control", _CONTROL)
        self._write(package / "usr/bin/rosrv", _ROSRV, executable=True)
        self._write(package / "etc/rosrv/policies/default.ini", _POLICY)
        self._write(tree / "usr/bin/systemctl", _SYSTEMCTL, executable=True)
        run(tree, "dpkg-deb", "--root-owner-group", "--build", "/srv/package", "/srv/rosrv_0.2.0_all.deb")

    @staticmethod
    def _write(path: Path, text: str, *, executable: bool = False) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755 if executable else 0o644)

    def play(self, **given: object) -> tuple[subprocess.CompletedProcess[str], list[str]]:
        asked = self.tree / "srv/asked"
        asked.write_text("")
        settings = {
            "rosrv_package": "/srv/rosrv_0.2.0_all.deb",
            "ansible_connection": "local",
            "ansible_python_interpreter": "/usr/bin/python3",
            "ansible_become": False,  # it is root
        }
        (self.tree / "srv/inventory").write_text("[robots]\nrobot\n")
        playbook = ("ansible-playbook", "-i", "/srv/inventory", "/examples/ansible/site.yml")
        done = tried(self.tree, *playbook, "-e", json.dumps(settings | given), ANSIBLE_NOCOLOR="1")
        return done, asked.read_text().splitlines()


def test_ansible_makes_a_robot_an_appliance(debian: Path) -> None:
    robot = Robot(debian)
    policy = debian / "etc/rosrv/policies/default.ini"

    done, asked = robot.play()
    assert done.returncode == 0, done.stdout + done.stderr
    assert "install ok installed" in run(debian, "dpkg-query", "--show", "--showformat=${Status}", "rosrv")
    assert (debian / "etc/rosrv/appliance.yaml").exists()
    assert policy.read_text() == _POLICY
    ours = [one for one in asked if not one.startswith("systemctl list")]
    assert ours == [
        "rosrv config", "systemctl enable rosrv", "systemctl start rosrv", "systemctl restart rosrv", "rosrv selftest",
    ]  # fmt: skip

    done, asked = robot.play()
    assert "changed=0" in done.stdout, done.stdout + done.stderr
    assert asked[-1] == "rosrv selftest"
    assert not any("restart" in one or "reload" in one for one in asked)

    (debian / "srv/new.ini").write_text(_POLICY + "[Publishers]\ndefault = vehicle\n")
    done, asked = robot.play(rosrv_policy="/srv/new.ini")
    assert done.returncode == 0, done.stdout + done.stderr
    assert asked[-2:] == ["systemctl reload rosrv", "rosrv selftest"]
    assert "[Publishers]" in policy.read_text()

    (debian / "srv/wrong.ini").write_text("[Publishers]\n/cmd_vel = nobody knows\n")
    done, asked = robot.play(rosrv_policy="/srv/wrong.ini")
    assert done.returncode != 0
    assert "failed to validate" in done.stdout
    assert "[Nodes]" in policy.read_text()
    assert not any(one.startswith("systemctl re") for one in asked)

    done, asked = robot.play(rosrv_settings={"policy": "policies/default.ini", "nonsense": 1})
    assert "failed to validate" in done.stdout
    assert not any(one.startswith("systemctl re") for one in asked)


def test_cloud_init_knows_every_key(debian: Path) -> None:
    said = run(debian, "cloud-init", "schema", "--config-file", "/examples/cloud-init/user-data.yaml")
    assert "Valid" in said
