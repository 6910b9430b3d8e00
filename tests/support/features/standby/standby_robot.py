import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Self

from tests.support.features.standby.standby_site import ADDRESSES, MASTER, ROBOT, StandbySite
from tests.support.nodes import Client, RosSession
from tests.support.processes import Process
from tests.support.waiting import eventually

_REGISTRAR = Path(__file__).with_name("standby_registrar.py")
_LARGE = "x" * 200_000
_DIGEST = hashlib.sha256(_LARGE.encode()).hexdigest()
CLIENTS: tuple[Client, Client] = ("rospy", "roscpp")


class StandbyRobot:
    def __init__(self, site: StandbySite, *, rate: float = 10) -> None:
        self.site, self.rate = site, rate
        self.ros: RosSession = site.ros()
        self.listeners: list[Process] = []
        self.callers: list[Process] = []

    def __enter__(self) -> Self:
        self.ros, self.listeners, self.callers = self.site.ros(), [], []
        ros = self.ros
        for here, there in (CLIENTS, CLIENTS[::-1]):
            ros.talker(here, f"/from_{here}", "--rate", str(self.rate), name=f"talker_{here}")
            self.listeners.append(ros.listener(there, f"/from_{here}", name=f"listener_{there}"))
            ros.service_server(here, f"/negate_{here}", name=f"server_{here}")
            self.callers.append(ros.service_client(there, f"/negate_{here}", name=f"caller_{there}"))
        ros.talker("roscpp", "/map", "--latch", "--text", "map", name="mapper")
        self.parameters = ros.parameters("rospy", name="parameters")
        self.parameters.send(json.dumps({"do": "set", "key": "/large", "value": _LARGE}))
        self.parameters.wait_for(event="done", do="set")
        self.registrar = ros.start([sys.executable, str(_REGISTRAR), MASTER, ROBOT], label="registrar")
        self.registrar.wait_for(event="ready")
        self.works()
        return self

    def __exit__(self, *exc: object) -> None:
        self.ros.__exit__(*exc)

    def cut(self) -> None:
        for process in self.ros.processes:
            process.kill()
        self.site.stop_witness()

    def boot(self) -> None:
        self.site.boot_robot()
        eventually(
            lambda: self.site.holder() and self.admitted() == {ADDRESSES[self.site.holder()]}, self.site.story
        )
        with self.site.ros() as ros:
            eventually(lambda: _LARGE in ros.run("rosparam", "get", "/large", check=False).stdout, ros.story)
        self.__exit__()
        self.__enter__()

    def works(self) -> None:
        marks = [(one, one.mark()) for one in self.listeners]
        for caller in self.callers:
            self.call(caller)
        self.registrar.wait_for(event="acknowledged", since=self.registrar.mark())
        for listener, mark in marks:
            listener.wait_for_count(3, since=mark, event="received")

    def call(self, caller: Process) -> int:
        failures = 0
        while True:
            mark = caller.mark()
            caller.send("true")
            event = caller.wait_for(lambda event: event.get("event") in {"answered", "failed"}, since=mark)
            if event["event"] == "answered":
                assert event["success"] is False, event
                return failures
            failures += 1

    def lost_nothing(self) -> None:
        self.works()
        ended = [process.story() for process in self.ros.processes if not process.running]
        assert not ended, "\n".join(ended)
        assert not [one for process in self.ros.processes for one in process.seen(event="ended")]
        mark = self.registrar.mark()
        self.registrar.send("check")
        checked = self.registrar.wait_for(event="checked", since=mark)
        assert checked["differences"] == []
        mark = self.parameters.mark()
        self.parameters.send(json.dumps({"do": "get", "key": "/large"}))
        got = self.parameters.wait_for(event="done", do="get", since=mark)["value"]
        assert hashlib.sha256(got.encode()).hexdigest() == _DIGEST

    def serves_newcomers(self) -> None:
        with self.site.ros() as ros:
            ros.listener("rospy", "/map").wait_for(event="received", data="map 1")
            assert {"/map", "/from_rospy", "/from_roscpp"} <= set(ros.run("rostopic", "list").stdout.split())
            assert "False" in ros.run("rosservice", "call", "/negate_roscpp", "true").stdout
            mark = self.listeners[0].mark()
            ros.talker("roscpp", "/from_rospy", name="newcomer")
            self.listeners[0].wait_for(event="received", publisher="/newcomer", since=mark)

    def admitted(self) -> set[str]:
        rules = self.site.robot.run(
            lambda: (
                subprocess.run(
                    ["nft", "list", "table", "ip", "rosrv_witness"],
                    capture_output=True,
                    text=True,
                    check=True,
                ).stdout
            )
        )
        return {line.rpartition("dnat to ")[2].strip() for line in rules.splitlines() if "dnat to" in line}
