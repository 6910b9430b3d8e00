import contextlib
import json
import os
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.features.standby.first_join import WITNESS_PORT
from appliance.features.standby.membership import Membership, load_membership, path_of
from examples.landshark.lab import Host, Lab
from tests.support.command import ROSRV, rosrv
from tests.support.features.standby.witness_site import ADDRESSES, FIXED, FOLLOWER, MASTER, NODE, ROBOT, Peer
from tests.support.processes import LIMIT
from tests.support.requirements import need_program, need_root
from tests.support.script_host import ScriptHost
from tests.support.waiting import eventually

_SYSTEMCTL = """\
#!/bin/sh
# Enough of systemd for the kits: it starts and stops the programs of the units.
set -eu
units=/etc/systemd/system
state=/run/rosrv
mkdir -p $state
command=
now=
names=
for word; do
    case $word in
        --now) now=yes ;;
        -*) ;;
        *) if [ -z "$command" ]; then command=$word; else names="$names ${word%.service}"; fi ;;
    esac
done
stop() {
    rm -f $state/$1.done
    [ -e $state/$1.pid ] || return 0
    pid=$(cat $state/$1.pid)
    kill -- -$pid 2>/dev/null || true
    while kill -0 $pid 2>/dev/null; do sleep 0.05; done
    rm -f $state/$1.pid $state/$1.ready $state/$1.notify
}
start() {
    for wanted in $(sed -n 's/^Wants=//p' $units/$1.service); do
        if [ -e $units/$wanted ]; then (start ${wanted%.service}); fi
    done
    line=$(sed -n 's/^ExecStart=//p' $units/$1.service)
    if grep -q ^Type=oneshot $units/$1.service; then
        [ -e $state/$1.done ] || { $line && : > $state/$1.done; }
    elif [ ! -e $state/$1.pid ]; then
        python3 -c 'if True:
            import pathlib, socket, sys
            manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            manager.settimeout(20)
            manager.bind(sys.argv[1] + ".notify")
            pathlib.Path(sys.argv[1] + ".ready").write_bytes(manager.recv(99))' $state/$1 >/dev/null 2>&1 &
        while [ ! -S $state/$1.notify ]; do sleep 0.05; done
        NOTIFY_SOCKET=$state/$1.notify setsid $line </dev/null >>$state/$1.log 2>&1 &
        echo $! > $state/$1.pid
    fi
}
for name in $names; do
    [ -e $units/$name.service ] || { echo "Unit $name.service not loaded" >&2; exit 5; }
    case $command in
        enable) echo $name >> $state/enabled ;;
        disable)
            sed -i "/^$name\\$/d" $state/enabled
            if [ -n "$now" ]; then stop $name; fi ;;
        restart) stop $name; start $name ;;
        stop) stop $name ;;
        is-active) kill -0 $(cat $state/$name.pid) && grep -q READY=1 $state/$name.ready || exit 3 ;;
        *) exit 1 ;;
    esac
done
"""

_JOURNALCTL = """\
#!/bin/sh
for word; do case $word in _SYSTEMD_UNIT=*.service) unit=${word#*=} ;; esac; done
exec tail -n 1 /run/rosrv/${unit%.service}.log
"""


class RobotSite:
    def __init__(self, lab: Lab, folder: Path, stack: contextlib.ExitStack) -> None:
        self._stack = stack
        self.hosts = {name: lab.host(name, f"{address}/24") for name, address in ADDRESSES.items()}
        self.attacker = lab.host("attacker", "10.77.0.66/24")
        programs = folder / "bin"
        programs.mkdir()
        for name, text in (("systemctl", _SYSTEMCTL), ("journalctl", _JOURNALCTL)):
            (programs / name).write_text(text)
            (programs / name).chmod(0o755)
        self._programs = programs
        self._path = f"{programs}:{os.environ['PATH']}:/usr/sbin"
        self.robot = self._host(lab.host("robot", f"{ROBOT}/24"), folder / "robot")
        self.follower = self._host(lab.host("follower", f"{FOLLOWER}/24"), folder / "follower")
        self.servers = {name: self._listening(host, MASTER) for name, host in self.hosts.items()}
        self.nodes = {
            host.outer.address: self._listening(host.outer, NODE) for host in (self.robot, self.follower)
        }
        self.kit = folder / "kit"
        self.state = folder / "state"
        self.join("kit")

    def join(self, kit: str, *more: str) -> None:
        self.kit = self.kit.with_name(kit)
        arguments = [f"--address={ADDRESSES['a']}", f"--other={ADDRESSES['b']}", f"--witness={ROBOT}"]
        arguments += [f"--fixed={FIXED}", f"--follower=arm={FOLLOWER}", "--ports=11311,20000-20999"]
        done = rosrv(
            "standby", "join", "--state", str(self.state), *arguments, "--output", str(self.kit), *more
        )
        assert done.returncode == 0, done.stderr

    def _host(self, outer: Host, folder: Path) -> ScriptHost:
        host = self._stack.enter_context(ScriptHost(outer, folder))
        host.run("mount", "-t", "tmpfs", "tmpfs", "/var/lib")
        host.run("mkdir", "-p", "/run/systemd/system")
        return host

    def _listening(self, host: Host, port: int) -> socket.socket:
        return self._stack.enter_context(host.run(lambda: socket.create_server((host.address, port))))

    def breaks(self, *names: str) -> None:
        for name in names:
            (self._programs / name).write_text("#!/bin/sh\necho Operation not supported >&2; exit 1\n")
            (self._programs / name).chmod(0o755)

    def repair(self, *names: str) -> None:
        for name in names:
            (self._programs / name).unlink()

    def script(
        self, host: ScriptHost, path: str | Path, *, check: bool = True
    ) -> subprocess.CompletedProcess[str]:
        return host.run("sh", str(path), check=check, PATH=self._path)

    def memberships(self) -> dict[str, Membership]:
        own, other = load_membership(path_of(self.state)), load_membership(self.kit / "standby-b.json")
        assert own is not None and other is not None
        return {"a": own, "b": other}

    def peer(self, name: str) -> Peer:
        peer = Peer(self.hosts[name], name, bytes.fromhex(self.memberships()[name].witness_key))
        self._stack.enter_context(peer.socket)
        return peer

    def connects(self, host: Host, address: str, port: int) -> bool:
        try:
            host.run(lambda: socket.create_connection((address, port), timeout=LIMIT / 3)).close()
        except OSError:
            return False
        return True

    def rules(self, host: ScriptHost) -> str:
        return host.run("nft", "list", "ruleset").stdout


@pytest.fixture
def site(tmp_path: Path) -> Iterator[RobotSite]:
    need_root()
    need_program("nft", "nftables")
    with Lab("rosrv-kit") as lab, contextlib.ExitStack() as stack:
        yield RobotSite(lab, tmp_path, stack)


def test_the_robots_kit_fences_the_appliances_beside_protect(site: RobotSite) -> None:
    robot, a, b = site.robot, site.peer("a"), site.peer("b")
    said = site.script(robot, site.kit / "witness" / "install.sh").stdout
    assert "the first lease is written: a has all data" in said
    assert f"ROS_MASTER_URI=http://{FIXED}:{MASTER}" in said
    assert robot.run("cat", "/run/rosrv/enabled").stdout.split() == ["rosrv-witness-shut", "rosrv-witness"]
    assert not any(site.connects(host, ROBOT, NODE) for host in site.hosts.values())
    assert "b is not in sync" in b.ask("claim", 0).reason or "holds the lease" in b.ask("claim", 0).reason
    epoch = a.granted(0)
    assert epoch == 2

    addresses = [f"--appliance={address}" for address in ADDRESSES.values()]
    robot.run(ROSRV, "protect", *addresses, "--ports=32768-60999", "--apply")
    assert site.connects(site.hosts["a"], ROBOT, NODE)
    assert not site.connects(site.hosts["b"], ROBOT, NODE)
    assert not site.connects(site.attacker, ROBOT, NODE)
    assert site.connects(robot.outer, FIXED, MASTER)
    assert a.ask("add", epoch).ok and a.ask("release", epoch).ok
    epoch = b.granted(epoch)
    assert site.connects(site.hosts["b"], ROBOT, NODE)
    assert not site.connects(site.hosts["a"], ROBOT, NODE)
    assert not site.connects(site.attacker, ROBOT, NODE)

    said = site.script(robot, site.kit / "witness" / "install.sh").stdout
    assert "the first lease" not in said, "b has the newer data"
    assert site.connects(site.hosts["b"], ROBOT, NODE)
    assert b.ask("renew", epoch).ok

    site.script(robot, "/etc/rosrv/remove-witness.sh")
    assert "rosrv_witness" not in site.rules(robot) and "rosrv_protect" in site.rules(robot)
    assert all(site.connects(host, ROBOT, NODE) for host in site.hosts.values())
    left = [
        file
        for file in robot.files()
        if "rosrv" in file and robot.run("test", "-e", file, check=False).returncode == 0
    ]
    assert left == []
    assert robot.run("ls", "/var/lib").stdout == ""
    assert robot.run("cat", "/run/rosrv/enabled").stdout == ""
    site.script(robot, site.kit / "witness" / "remove.sh")  # again: there is nothing to remove


def test_a_follower_and_the_robot_are_installed_in_any_order(site: RobotSite) -> None:
    follower = site.follower
    site.script(follower, site.kit / "follower-arm" / "install.sh")
    assert not any(site.connects(host, FOLLOWER, NODE) for host in site.hosts.values())
    site.script(site.robot, site.kit / "witness" / "install.sh")
    a = site.peer("a")
    epoch = a.granted(0)

    def admitted() -> bool:
        assert a.ask("renew", epoch).ok
        return site.connects(follower.outer, FIXED, MASTER)

    eventually(admitted, lambda: follower.run("cat", "/run/rosrv/rosrv-witness-follow.log").stdout)
    assert not site.connects(site.hosts["b"], FOLLOWER, NODE)
    site.script(follower, "/etc/rosrv/remove-witness.sh")
    assert site.rules(follower) == ""
    assert site.connects(site.hosts["b"], FOLLOWER, NODE)


def test_a_program_that_ends_at_its_start_is_not_reported_as_running(site: RobotSite) -> None:
    def fails(host: ScriptHost, kit: str, reason: str) -> None:
        done = site.script(host, site.kit / kit / "install.sh", check=False)
        assert done.returncode == 1 and reason in done.stderr
        assert " runs" not in done.stdout and "rosrv_witness" in site.rules(host)

    with site.robot.outer.run(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as taken:
        taken.bind(("0.0.0.0", WITNESS_PORT))  # as a process of ROS 2 has it
        fails(site.robot, "witness", f"UDP {ROBOT}:{WITNESS_PORT}: Address already in use")
    assert " runs" in site.script(site.robot, site.kit / "witness" / "install.sh").stdout
    assert " runs" in site.script(site.follower, site.kit / "follower-arm" / "install.sh").stdout
    (site.kit / "follower-arm" / "witness.json").write_text("damaged")
    fails(site.follower, "follower-arm", "witness.json cannot be used")


def test_a_new_kit_begins_a_new_lease_with_the_first_appliance_alone_in_sync(site: RobotSite) -> None:
    robot = site.robot
    site.script(robot, site.kit / "witness" / "install.sh")
    a = site.peer("a")
    epoch = a.granted(0)
    assert a.ask("add", epoch).ok
    lease = site.state / "lease" / "epoch"
    lease.parent.mkdir()
    lease.write_text(f"{epoch}\n")
    site.join("new", "--force")
    site.script(robot, site.kit / "witness" / "install.sh")
    a, b = site.peer("a"), site.peer("b")
    assert a.granted(epoch) == epoch + 2
    assert b.ask("look", epoch).in_sync == frozenset({"a"})
    site.script(robot, site.kit.with_name("kit") / "witness" / "install.sh")
    assert not site.connects(site.hosts["b"], ROBOT, NODE), "the old kit's keys are not the appliances'"


def test_a_kernel_without_nf_tables_gets_the_rules_of_iptables(site: RobotSite) -> None:
    need_program("iptables-restore", "iptables")
    robot, a, b = site.robot, site.peer("a"), site.peer("b")
    site.breaks("nft")
    said = site.script(robot, site.kit / "witness" / "install.sh").stdout
    assert "nft fails here, so the rules are those of iptables: Operation not supported" in said
    for unit in ("rosrv-witness", "rosrv-witness-shut"):
        assert " --backend iptables\n" in robot.run("cat", f"/etc/systemd/system/{unit}.service").stdout
    epoch = a.granted(0)
    assert site.connects(robot.outer, FIXED, MASTER)
    assert not site.connects(site.hosts["b"], ROBOT, NODE)
    assert a.ask("add", epoch).ok and a.ask("release", epoch).ok
    b.granted(epoch)
    assert site.connects(site.hosts["b"], ROBOT, NODE)
    assert not site.connects(site.hosts["a"], ROBOT, NODE)

    site.breaks("iptables-save", "iptables-restore")
    done = site.script(robot, "/etc/rosrv/remove-witness.sh", check=False)
    assert done.returncode == 1 and "no program can remove the rules" in done.stderr
    site.repair("iptables-save", "iptables-restore")
    done = site.script(robot, "/etc/rosrv/remove-witness.sh")
    assert "warning: nft fails" in done.stderr
    assert "rosrv" not in robot.run("iptables-save").stdout
    assert all(site.connects(host, ROBOT, NODE) for host in site.hosts.values())
    for path in ("/etc/rosrv", "/var/lib/rosrv-witness", "/etc/systemd/system/rosrv-witness.service"):
        assert robot.run("test", "-e", path, check=False).returncode


def test_without_a_working_program_nothing_is_installed(site: RobotSite) -> None:
    site.breaks("nft", "iptables-save")
    done = site.script(site.robot, site.kit / "witness" / "install.sh", check=False)
    assert done.returncode == 1 and "nft fails, and iptables does not work either" in done.stderr
    assert site.robot.run("test", "-e", "/etc/rosrv", check=False).returncode


def test_an_incomplete_kit_changes_nothing(site: RobotSite) -> None:
    (site.kit / "witness" / "witness.json").unlink()
    done = site.script(site.robot, site.kit / "witness" / "install.sh", check=False)
    assert done.returncode == 1 and "copy the whole folder" in done.stderr
    assert site.rules(site.robot) == ""
    assert site.robot.run("test", "-e", "/etc/rosrv/witness.py", check=False).returncode


def test_a_python_that_cannot_run_the_program_changes_nothing(site: RobotSite) -> None:
    program = site.kit / "witness" / "witness.py"
    program.write_text("import hmac_that_is_missing\n" + program.read_text())
    done = site.script(site.robot, site.kit / "witness" / "install.sh", check=False)
    assert done.returncode == 1 and "No module named 'hmac_that_is_missing'" in done.stderr
    assert "sudo apt install python3" in done.stderr
    assert site.robot.run("test", "-e", "/etc/rosrv/witness.py", check=False).returncode


def test_damaged_settings_can_be_removed(site: RobotSite) -> None:
    robot = site.robot
    site.script(robot, site.kit / "witness" / "install.sh")
    robot.run("sh", "-c", "echo damaged > /etc/rosrv/witness.json")
    site.script(robot, "/etc/rosrv/remove-witness.sh")
    assert site.rules(robot) == ""
    assert json.loads((site.kit / "witness" / "witness.json").read_text())["fixed"] == FIXED


def test_the_scripts_are_posix_and_complete(site: RobotSite) -> None:
    for script in site.kit.glob("*/*.sh"):
        done = subprocess.run(["/bin/dash", "-n", str(script)], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")
        assert "@" not in script.read_text().replace('"$@"', "")
