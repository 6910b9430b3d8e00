"""Masters that the tests of a worker share, each lent to one test at a time, which must leave it as it was.

A test runs with the same robot behind the plain ROS master, which validates the test, and behind the appliance. Tests
that crash, restart or configure a master start their own.
"""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, Self

from appliance.channel.admin import StatusWanted, TokenList
from examples.landshark.lab import Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession
from tests.support.processes import Host, ThisMachine
from tests.support.requirements import need_root
from tests.support.rosmaster import PlainMaster, await_node, call_on
from tests.support.waiting import eventually

Mode = Literal["plain", "appliance"]
Place = Literal["loopback", "lab"]
_ASKER = "/reset"


class Site:
    """A master with an open policy, and its hosts. On the loopback the appliance has REST.

    In a lab the firewall is in force. The master is 10.77.0.2, `robot` 10.77.0.10 and `ocu` 10.77.0.20.
    """

    def __init__(self, mode: Mode, home: Path, lab: Lab | None = None) -> None:
        self.mode = mode
        self.home = home
        self._lab = lab
        here = ThisMachine()
        self.robot: Host = here if lab is None else lab.host("robot", "10.77.0.10/24")
        self.ocu: Host = here if lab is None else lab.host("ocu", "10.77.0.20/24")
        middle = here if lab is None else lab.host("master", "10.77.0.2/24")
        self.master: PlainMaster | Appliance = (
            PlainMaster(home, middle)
            if mode == "plain"
            else Appliance(middle, options=("--api", "127.0.0.1:0" if lab is None else "off"))
        )
        self._first: dict[str, Any] = {}

    @property
    def master_uri(self) -> str:
        return self.master.master_uri

    @property
    def appliance(self) -> Appliance:
        assert isinstance(self.master, Appliance)
        return self.master

    @property
    def lab(self) -> Lab:
        assert self._lab is not None
        return self._lab

    def story(self) -> str:
        return self.master.story()

    def state(self) -> dict[str, Any]:
        if isinstance(self.master, PlainMaster):
            of_master: dict[str, Any] = {"running": [process.running for process in self.master.processes]}
        else:
            status, tokens = self.master.ask(StatusWanted()), self.master.ask(TokenList()).tokens
            of_master = {
                # the compiler runs only for a while, on demand
                "processes": {(row.role, row.pid) for row in status.processes if row.role != "compiler"},
                "policy": (status.policy.revision, status.policy.differs_from_file),
                "monitors": (status.monitors.loaded, status.monitors.shadow),
                "tokens": [token.name for token in tokens if token.revoked is None],
            }
        return of_master | {
            "graph": [sorted(rows) for rows in self._call("getSystemState")],
            "parameters": self._call("getParam", "/"),
        }

    def reset(self) -> None:
        now = self.state()
        if now["parameters"] != self._first["parameters"]:
            self._call("setParam", "/", self._first["parameters"])
        if now | {"parameters": self._first["parameters"]} == self._first:
            return
        with RosSession(self.master_uri, self.home, self.robot) as ros:
            ros.run("rosnode", "cleanup", text="y\n", check=False)

        def left() -> str:
            now = self.state()
            return "\n".join(
                f"{name}: {now[name]}, was {was}" for name, was in self._first.items() if now[name] != was
            )

        eventually(lambda: not left(), lambda: f"the test leaves the {self.mode} master as it was\n{left()}")

    def _call(self, method: str, *parameters: Any) -> Any:
        code, text, value = call_on(self.robot, self.master_uri, method, _ASKER, *parameters)
        assert code == 1, text
        return value

    def __enter__(self) -> Self:
        self.master.__enter__()
        try:
            await_node(self.master_uri, self.robot, "/rosout")
            # Its subscription is the last thing that rosout registers.
            eventually(lambda: self._call("getSystemState")[1], "rosout subscribes to /rosout")
            self._first = self.state()
        except BaseException:
            self.master.__exit__()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self.master.__exit__(*exc)


class Masters:
    def __init__(self, new_home: Callable[[str], Path]) -> None:
        self._new_home = new_home
        self._running: dict[tuple[Mode, Place], tuple[Site, contextlib.ExitStack]] = {}

    @contextlib.contextmanager
    def lend(self, mode: Mode, place: Place) -> Iterator[Site]:
        if (mode, place) != ("plain", "loopback"):
            need_root()
        if (mode, place) not in self._running:
            with contextlib.ExitStack() as stack:
                lab = None if place == "loopback" else stack.enter_context(Lab("rosrv-test"))
                site = stack.enter_context(Site(mode, self._new_home(f"{mode}-{place}"), lab))
                self._running[mode, place] = site, stack.pop_all()
        site, running = self._running[mode, place]
        try:
            yield site
            site.reset()
        except BaseException:
            del self._running[mode, place]
            running.close()
            raise

    def close(self) -> None:
        with contextlib.ExitStack() as closing:
            for _site, running in self._running.values():
                closing.push(running)
