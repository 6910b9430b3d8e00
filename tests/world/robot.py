"""The robot's computer, with the product's witness and its firewall rules on a disk that keeps the lease."""

import re
from typing import TYPE_CHECKING

from appliance.base import clock
from appliance.features.standby.witness.firewall import LeaseFirewall
from appliance.features.standby.witness.lease_file import LeaseRecord
from appliance.features.standby.witness.lease_rules import Witness
from appliance.features.standby.witness.protocol import LONGEST, Left
from appliance.features.standby.witness.request_gate import WitnessGate
from appliance.features.standby.witness.settings import WitnessSettings
from tests.world.loop import Machine, Process
from tests.world.network import Address
from tests.world.streams import DatagramSocket, Streams

if TYPE_CHECKING:
    from tests.world.pair import PairWorld

PORT = 7411


class Robot:
    def __init__(self, world: "PairWorld", machine: Machine, settings: WitnessSettings) -> None:
        self._world = world
        self._machine = machine
        self._settings = settings
        self._record = LeaseRecord(1, "", tuple(sorted(settings.appliances)), "")
        self._rules = ""
        self._firewall = LeaseFirewall(settings, "nft", self._nft)
        self._firewall.admit("")
        self.process: Process
        self.start()

    def start(self) -> None:
        self.process = self._world.process("witness", self._machine)
        self.process.run(self._serve, self._world.streams)

    def restart(self) -> None:
        self.process.kill()
        self.start()

    def _serve(self, streams: Streams) -> None:
        keeper = Witness(
            record=self._record,
            save=self._save,
            admit=self._firewall.admit,
            boot="boot",
            clock=clock.since_boot,
        )
        nonce = f"{self._world.random.getrandbits(64):x}"
        gate = WitnessGate(keeper, self._settings.appliances, nonce)
        sock = DatagramSocket(streams)
        sock.bind(("", PORT))

        def answer() -> None:
            datagram, source = sock.recvfrom(LONGEST + 1)
            given = gate.answer(datagram, source[0])
            if given is not None:
                sock.sendto(given, source)

        sock.readable = answer

    def _save(self, record: LeaseRecord) -> None:
        self._record = record

    def _nft(self, command: list[str], text: str, _left: Left) -> str:
        if command[1] == "-f":
            self._rules = text
        return self._rules

    def admits(self, address: str) -> bool:
        return f"ip saddr {address} drop" not in self._rules

    def translated(self, address: Address) -> Address | None:
        match = re.search(r"dnat to (\S+)", self._rules)
        return (match[1].rstrip(";"), address[1]) if match else None
