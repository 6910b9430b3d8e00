"""An appliance and hosts on one Ethernet: some behind tunnels, some in clear text, and an attacker."""

import contextlib
import json
import re
import ssl
import subprocess
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Self

from appliance.network import interfaces
from examples.landshark.lab import INTERFACE, Host, Lab
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.processes import LIMIT, Event, Process, ThisMachine
from tests.support.rest import Rest
from tests.support.tunnels import JoinedHost
from tests.support.waiting import eventually

MIDDLE, ROBOT, OCU, ATTACKER = "10.88.0.2", "10.88.0.10", "10.88.0.20", "10.88.0.66"
MASTER = f"http://{MIDDLE}:11311"
OWN = "10.113.11.1"  # the appliance's address in the tunnels
API = 8443  # REST's port, where a site has REST
LONG = 2 * LIMIT  # seconds
POLICY = f"""\
[Groups]
trusted = host:ocu-1, {ROBOT}
[Nodes]
default = trusted
[Publishers]
default = trusted
[Subscribers]
default = trusted
[Commands]
default = trusted
"""


class TunnelSite:
    trail: Process

    def __init__(self, lab: Lab, home: Path, *, policy: str = POLICY, options: tuple[str, ...] = ()) -> None:
        self.lab, self.home = lab, home
        self.appliance = Appliance(
            lab.host("appliance", f"{MIDDLE}/24"),
            policy=policy,
            options=("--listen", "0.0.0.0:11311", *options),
        )
        self.robot = lab.host("robot", f"{ROBOT}/24")
        self.ocu = lab.host("ocu", f"{OCU}/24")
        self.attacker = lab.host("attacker", f"{ATTACKER}/24")
        self.kits = 0

    def kit(self, verb: str = "add", name: str = "ocu-1", *options: str) -> Path:
        self.kits += 1
        path = self.home / f"kit-{self.kits}.tar.gz"
        self.appliance.rosrv("host", verb, name, "--appliance", MIDDLE, "--output", str(path), *options)
        return path

    def join(self, kit: Path, host: Host | None = None, *, log: str = "") -> JoinedHost:
        return JoinedHost(host or self.ocu, kit, self.home / f"joined-{time.monotonic_ns()}", log=log)

    @contextlib.contextmanager
    def joined(
        self, kit: Path, host: Host | None = None, *, log: str = "", settings: str = ""
    ) -> Iterator[JoinedHost]:
        mark = self.mark
        joined = self.join(kit, host, log=log)
        conf = joined.folder / "swanctl" / "swanctl.conf"
        conf.write_text(conf.read_text() + settings)
        with joined:
            joined.wait_until_up()
            self.recorded(mark, event="tunnel up", host=joined.address)
            yield joined
            mark = self.mark
            stands = self.stands(joined.address)
        if stands:
            self.recorded(mark, event="tunnel down", host=joined.address)

    @contextlib.contextmanager
    def talking(self, joined: JoinedHost, rate: int = 10) -> Iterator[tuple[Process, Process]]:
        with (
            RosSession(joined.master, self.home, joined) as there,
            RosSession(MASTER, self.home, self.robot) as here,
        ):
            talker = there.talker("rospy", "/orders", "--rate", str(rate), name="boss")
            listener = here.listener("rospy", "/orders", name="arm")
            listener.wait_for(event="received")
            yield talker, listener

    def stands(self, address: str) -> bool:
        changes = [
            one for one in self.trail.seen(host=address) if one["event"] in ("tunnel up", "tunnel down")
        ]
        return bool(changes) and changes[-1]["event"] == "tunnel up"

    def hosts(self) -> list[dict[str, Any]]:
        return list(map(json.loads, self.appliance.rosrv("host", "list", "--json").stdout.splitlines()))

    def state(self, name: str = "ocu-1") -> str:
        return next(str(row["state"]) for row in self.hosts() if row["name"] == name)

    def is_up(self, name: str = "ocu-1") -> dict[str, Any]:
        return eventually(
            lambda: next((one for one in self.hosts() if (one["name"], one["state"]) == (name, "up")), None),
            f"the tunnel of {name} is up",
        )

    def is_down(self, name: str = "ocu-1") -> None:
        eventually(lambda: self.state(name) != "up", f"the tunnel of {name} is closed")

    def recorded(self, since: int, timeout: float = LONG, **fields: Any) -> Event:
        return self.trail.wait_for(since=since, timeout=timeout, **fields)

    def refused(self, since: int, host: str | None = None) -> Event:
        def is_it(event: Event) -> bool:
            folded = event.get("event") == "denials folded" and event["detail"]["of"] == "tunnel refused"
            return (folded or event.get("event") == "tunnel refused") and host in (None, event.get("host"))

        found = self.trail.wait_for(is_it, since=since, timeout=LONG)
        return found | {"reason": " ".join([found["reason"], *found["detail"].get("reasons", ())])}

    def story(self) -> str:
        return self.appliance.story()

    def rest(self) -> Rest:
        # The kernel accepts connections before the process is ready: one answer shows that it is.
        served = self.attacker.run(partial(ssl.get_server_certificate, (MIDDLE, API), timeout=LONG))
        (self.home / "api.pem").write_text(served)
        return Rest(f"https://{MIDDLE}:{API}", self.appliance.token, self.home / "api.pem")

    @property
    def mark(self) -> int:
        return len(self.trail.events)

    def __enter__(self) -> Self:
        self.appliance.__enter__()
        try:
            self.watch()
        except BaseException:
            self.appliance.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self.trail.stop()
        self.appliance.close()

    def watch(self) -> None:
        command = [ROSRV, "audit", "tail", "--json", "--state", str(self.appliance.state)]
        self.trail = Process(
            ThisMachine(), command, env={"PYTHONUNBUFFERED": "1"}, label="audit tail"
        ).__enter__()


def left_behind(host: Host) -> dict[str, str]:
    def told(*command: str) -> str:
        process = host.popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        return str(process.communicate(timeout=LIMIT)[0]).strip()

    iptables = told("iptables-legacy-save") + told("ip6tables-legacy-save")
    found = {
        "states": told("ip", "xfrm", "state"),
        "policies": told("ip", "xfrm", "policy"),
        "nftables": told("nft", "list", "ruleset"),
        "iptables": "ROSRV" if "ROSRV" in iptables else "",
        "routes": told("ip", "route", "show", "table", "220"),
        "interfaces": " ".join(
            link for link in interfaces.links(host.namespace) if link not in ("lo", INTERFACE)
        ),
        "addresses": OWN if OWN in " ".join(interfaces.addresses(host.namespace)) else "",
    }
    return {name: text for name, text in found.items() if text}


def numbers(listener: Process) -> list[int]:
    return [int(re.split(r"\s", str(event["data"]))[-1]) for event in listener.seen(event="received")]
