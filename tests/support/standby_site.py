"""Two appliances, and a robot with the witness, on one Ethernet.

`active` and `passive` are the appliances by their role. `cut` ends all processes of an appliance at once and takes its
link down, as a power cut does.
"""

import contextlib
import json
import os
import shutil
import signal
import sys
from pathlib import Path
from typing import Any, Self

from appliance.network import interfaces
from appliance.standby import witness
from appliance.standby.kit import PairPlan, make_kits
from appliance.standby.membership import PORT, Membership, path_of, save_membership
from appliance.standby.witness import LeaseRecord
from examples.landshark.lab import INTERFACE, Lab
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.processes import LIMIT, Process
from tests.support.waiting import eventually

ROBOT, FIXED, OCU = "10.79.0.10", "10.79.0.100", "10.79.0.20"
ADDRESSES = {"a": "10.79.0.2", "b": "10.79.0.3"}
MASTER = f"http://{FIXED}:11311"
PORTS = ["11311", "19001-26000"]


def memberships(folder: Path) -> tuple[dict[str, Membership], dict[str, Any]]:
    """Return the memberships of both appliances, and the settings of the witness."""
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
        followers={},
    )
    kits = make_kits(plan)
    (settings,) = (json.loads(file.text) for file in kits.folders["witness"] if file.name == "witness.json")
    return {"a": kits.own, "b": kits.other}, settings | {"state": str(folder / "lease")}


class StandbySite:
    """The site; a context manager. `a` is in sync at first."""

    def __init__(
        self, lab: Lab, home: Path, *, policy: str = OPEN_POLICY, options: tuple[str, ...] = (), **more: Any
    ) -> None:
        self.lab, self.home = lab, home
        self.robot = lab.host("robot", f"{ROBOT}/24")
        members, settings = memberships(home)
        self.settings = home / "witness.json"
        self.settings.write_text(json.dumps(settings))
        self.settings.chmod(0o600)
        shutil.copy(str(witness.__file__), home / "witness.py")
        self.lease = witness.LeaseFile(str(home / "lease"), ("a", "b"))
        self.witness: Process | None = None
        self.appliances: dict[str, Appliance] = {}
        for name, address in ADDRESSES.items():
            one = Appliance(
                lab.host(name, f"{address}/24"),
                policy=policy,
                options=("--listen", "0.0.0.0:11311", *options),
                **more,
            )
            one.state.mkdir(mode=0o711)
            save_membership(path_of(one.state), members[name])
            self.appliances[name] = one

    def command(self, *words: str) -> list[str]:
        """Return a command of the witness, as on a robot without the product."""
        return [
            sys.executable,
            "-I",
            "-S",
            str(self.home / "witness.py"),
            *words,
            "--settings",
            str(self.settings),
        ]

    def start_witness(self) -> None:
        """Start the witness; at the first start with a lease of which `a` is in sync."""
        if not (self.home / "lease").exists():
            self.lease.write(LeaseRecord(1, "", ("a",), ""))
        self.witness = Process(self.robot, self.command("serve"), env=dict(os.environ), label="witness")

    def start(self, name: str) -> Process:
        """Start an appliance; return when it could take over or is active, and its process."""
        one = self.appliances[name]
        one.process = Process(one.host, self._up(one), env=dict(os.environ), label=f"rosrv up {name}")
        one.process.wait_for(lambda event: event.get("event") in {"standby", "ready"}, timeout=2 * LIMIT)
        return one.process

    def _up(self, one: Appliance) -> list[str]:
        return [
            ROSRV, "up", "--json", "--isolation", "container", "--state", str(one.state), "--policy",
            str(one.policy_file), *one.options,
        ]  # fmt: skip

    def holder(self) -> str:
        """Return the holder of the lease; empty if there is none yet."""
        return self.lease.read().holder

    def in_sync(self) -> set[str]:
        """Return the appliances in sync."""
        return set(self.lease.read().in_sync)

    def until_both_in_sync(self) -> None:
        """Wait until both appliances are in sync."""
        eventually(lambda: self.in_sync() == {"a", "b"}, self.story)

    def cut(self, name: str) -> None:
        """Cut the power of an appliance."""
        namespace = self.lab.hosts[name].namespace
        interfaces.set_link(namespace, INTERFACE, up=False)
        for pid in namespace.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def story(self) -> str:
        """Return the output of all."""
        witness_said = "\n".join(self.witness.errors) if self.witness is not None else ""
        return "\n".join([witness_said, *(one.story() for one in self.appliances.values())])

    def ros(self) -> RosSession:
        """Return nodes on the robot, which use the fixed address."""
        return RosSession(MASTER, self.home, self.robot)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        for one in self.appliances.values():
            one.close()
        if self.witness is not None:
            self.witness.stop()
