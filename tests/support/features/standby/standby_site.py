import contextlib
import json
import os
import secrets
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from appliance.features.standby.first_join import PairPlan, make_kits
from appliance.features.standby.membership import PORT, Membership, path_of, save_membership
from appliance.features.standby.replica_sync import MARK
from appliance.features.standby.witness.lease_file import LeaseFile, LeaseRecord
from appliance.features.standby.witness.one_file import witness_program
from appliance.network import interfaces
from examples.landshark.lab import INTERFACE, Host, Lab
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.processes import LIMIT, Process
from tests.support.waiting import eventually

ROBOT, FIXED, OCU, ARM = "10.79.0.10", "10.79.0.100", "10.79.0.20", "10.79.0.30"
ADDRESSES = {"a": "10.79.0.2", "b": "10.79.0.3"}
MASTER_PORT = 11311
MASTER = f"http://{FIXED}:{MASTER_PORT}"
PORTS = ["11311", "19001-26000"]


def memberships(folder: Path) -> tuple[dict[str, Membership], dict[str, Any], dict[str, Any]]:
    plan = PairPlan(
        name="a",
        address=ADDRESSES["a"],
        other="b",
        other_address=ADDRESSES["b"],
        witness=ROBOT,
        fixed=FIXED,
        port=PORT,
        ports=tuple(PORTS),
        master_port=11311,
        epoch=1,
        followers={"arm": ARM},
    )
    kits = make_kits(plan)
    witness, follower = (
        json.loads(next(file.text for file in kits.folders[name] if file.name == "witness.json"))
        for name in ("witness", "follower-arm")
    )
    members = {"a": kits.own, "b": kits.other}
    return members, witness | {"state": str(folder / "lease")}, follower | {"state": str(folder / "followed")}


class StandbySite:
    def __init__(
        self,
        lab: Lab,
        home: Path,
        *,
        lease_folder: Path | None = None,
        policy: str = OPEN_POLICY,
        options: tuple[str, ...] = (),
        **more: Any,
    ) -> None:
        self.lab, self.home = lab, home
        self.robot = lab.host("robot", f"{ROBOT}/24")
        members, settings, follower = memberships(lease_folder or home)
        self.settings, self._follower_settings = home / "witness.json", home / "follower.json"
        for path, body in ((self.settings, settings), (self._follower_settings, follower)):
            path.write_text(json.dumps(body))
            path.chmod(0o600)
        (home / "witness.py").write_text(witness_program())
        (home / "boot").write_text(secrets.token_hex(8))
        self.lease = LeaseFile(settings["state"], ("a", "b"))
        self.witness: Process | None = None
        self._follower: Process | None = None
        self.appliances: dict[str, Appliance] = {}
        for name, address in ADDRESSES.items():
            appliance = Appliance(
                lab.host(name, f"{address}/24"),
                policy=policy,
                options=("--listen", "0.0.0.0:11311", *options),
                **more,
            )
            appliance.state.mkdir(mode=0o711)
            save_membership(path_of(appliance.state), members[name])
            self.appliances[name] = appliance

    def command(self, *words: str, settings: Path | None = None) -> list[str]:
        program = (
            f"import sys; sys.path.insert(0, {str(self.home)!r}); import witness;"
            f" witness.BOOT_ID = {str(self.home / 'boot')!r}; sys.exit(witness.main(sys.argv[1:]))"
        )
        return [
            sys.executable,
            "-I",
            "-S",
            "-c",
            program,
            *words,
            "--settings",
            str(settings or self.settings),
        ]

    def start_follower(self) -> Host:
        arm = self.lab.host("arm", f"{ARM}/24")
        command = ["nice", "-n", "-10", *self.command("follow", settings=self._follower_settings)]
        self._follower = Process(arm, command, env=dict(os.environ), label="follower")
        self._follower.wait_for_error("follows the witness")
        return arm

    def start_witness(self) -> None:
        if not Path(self.lease.path).exists():
            self.lease.write(LeaseRecord(1, "", ("a",), ""))
        command = ["nice", "-n", "-10", *self.command("serve")]  # as its unit does
        self.witness = Process(self.robot, command, env=dict(os.environ), label="witness")
        self.witness.wait_for_error("the witness answers at")

    def stop_witness(self) -> None:
        assert self.witness is not None
        self.witness.stop(with_signal=signal.SIGKILL)

    def run_witness(self, *words: str) -> None:
        with Process(self.robot, self.command(*words), env=dict(os.environ), label=words[0]) as done:
            assert done.wait() == 0, done.story()

    def boot_robot(self) -> None:
        self.run_witness("remove")
        self.run_witness("shut")
        (self.home / "boot").write_text(secrets.token_hex(8))
        self.start_witness()

    def begin(self) -> None:
        """Start the witness and the active appliance a, then its standby b."""
        self.start_witness()
        self.start("a")
        self.until_active("a")
        self.start("b")
        self.until_both_in_sync()

    def start(self, name: str) -> Process:
        one = self.appliances[name]
        one.process = Process(one.host, self._up(one), env=dict(os.environ), label=f"rosrv up {name}")
        one.process.wait_for(lambda event: event.get("event") in {"standby", "ready"}, timeout=2 * LIMIT)
        return one.process

    def _up(self, appliance: Appliance) -> list[str]:
        return [
            ROSRV, "up", "--json", "--isolation", appliance.isolation, "--state", str(appliance.state), "--policy",
            str(appliance.policy_file), *appliance.options,
        ]  # fmt: skip

    def holder(self) -> str:
        return self.lease.read().holder

    def in_sync(self) -> set[str]:
        return set(self.lease.read().in_sync)

    def until_both_in_sync(self) -> None:
        eventually(lambda: self.in_sync() == {"a", "b"}, self.story)

    def cut(self, name: str) -> None:
        """Cut the power of an appliance, whose next start follows a boot of its machine."""
        interfaces.set_link(self.lab.hosts[name].namespace, INTERFACE, up=False)
        self.signal(name, signal.SIGKILL)
        mark = self.appliances[name].state / "control" / MARK
        assert mark.exists()
        mark.write_text("an earlier boot", "ascii")

    def restore(self, name: str) -> None:
        one = self.appliances[name]
        if one.process is not None:
            one.process.stop()
        interfaces.set_link(self.lab.hosts[name].namespace, INTERFACE, up=True)
        self.start(name)

    def pair(self) -> tuple[str, str]:
        holder = self.holder()
        return holder, {"a": "b", "b": "a"}[holder]

    def until_active(self, name: str) -> None:
        one = self.appliances[name].process
        assert one is not None
        one.wait_for(event="ready", timeout=2 * LIMIT)

    def promote(self, name: str) -> None:
        eventually(
            lambda: self.holder() != name or self.appliances[name].rosrv("standby", "switch"), self.story
        )

    def until_taken_over(self, name: str) -> None:
        eventually(lambda: self.holder() == name, self.story)

    def pids(self, name: str, role: str = "") -> list[int]:
        one = self.appliances[name].process
        assert one is not None
        title = b"/usr/bin/rosmaster\0" if role == "rosmaster" else f"rosrv: {role}".encode()
        found, left = [], [one.pid]
        while left:
            pid = left.pop()
            with contextlib.suppress(OSError):
                left += map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
                if not role or title in Path(f"/proc/{pid}/cmdline").read_bytes():
                    found.append(pid)
        return found

    def signal(self, name: str, number: int) -> None:
        for pid in self.pids(name):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)

    def without_link(self, *pairs: tuple[str, str]) -> contextlib.AbstractContextManager[None]:
        return self._filtered("drop", *pairs)

    def slow_link(self, kilobytes_a_second: int) -> contextlib.AbstractContextManager[None]:
        """Slow down the replication, but not the promises."""
        rate = f"limit rate over {kilobytes_a_second} kbytes/second burst 16 kbytes"
        return self._filtered(f"ip protocol tcp {rate} drop", (ADDRESSES["a"], ADDRESSES["b"]))

    @contextlib.contextmanager
    def _filtered(self, rule: str, *pairs: tuple[str, str]) -> Iterator[None]:
        ways = [way for here, there in pairs for way in ((here, there), (there, here))]
        self._switch(
            "add table bridge lost",
            "add chain bridge lost some { type filter hook forward priority 0 ; }",
            *(f"add rule bridge lost some ip saddr {one} ip daddr {other} {rule}" for one, other in ways),
        )
        try:
            yield
        finally:
            self._switch("delete table bridge lost")

    def _switch(self, *rules: str) -> None:
        text = "\n".join(rules)
        self.lab.switch.run(lambda: subprocess.run(["nft", "-f", "-"], input=text, text=True, check=True))

    def story(self) -> str:
        witness_said = "\n".join(self.witness.errors) if self.witness is not None else ""
        return "\n".join([witness_said, *(appliance.story() for appliance in self.appliances.values())])

    def ros(self) -> RosSession:
        return RosSession(MASTER, self.home, self.robot)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        for appliance in self.appliances.values():
            appliance.close()
        for process in (self.witness, self._follower):
            if process is not None:
                process.stop()
