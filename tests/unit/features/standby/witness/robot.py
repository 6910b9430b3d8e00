from appliance.features.standby.witness.errors import UncertainError, WitnessError
from appliance.features.standby.witness.lease_file import LeaseRecord
from appliance.features.standby.witness.lease_rules import Witness
from appliance.features.standby.witness.protocol import EXPIRY
from appliance.features.standby.witness.request_gate import WitnessGate
from appliance.features.standby.witness.settings import AppliancePeer, WitnessSettings

KEYS = {"a": b"a" * 32, "b": b"b" * 32}


PEERS = {"a": AppliancePeer("10.0.0.2", KEYS["a"]), "b": AppliancePeer("10.0.0.3", KEYS["b"])}


PAIR_SETTINGS = WitnessSettings(("10.0.0.1", 7411), "10.0.0.100", ("11311",), PEERS, "/lease", {}, "")


BOTH = ("a", "b")


FIRST = LeaseRecord(1, "", BOTH, "")


class Robot:
    def __init__(self, record: LeaseRecord | None = FIRST, boot: str = "one") -> None:
        self.now = 100.0
        self.disk = record
        self.admits: list[str] = []
        self.disk_full = self.firewall_fails = self.uncertain = False
        self.witness = Witness(
            record=record, save=self.save, admit=self.admit, boot=boot, clock=lambda: self.now
        )
        self.gate = WitnessGate(self.witness, PEERS, "nonce")

    def save(self, record: LeaseRecord) -> None:
        if self.disk_full:
            raise self.failure("the disk is full")
        self.disk = record

    def admit(self, name: str) -> None:
        if self.firewall_fails:
            raise self.failure("nft: no")
        self.admits.append(name)

    @property
    def failure(self) -> type[WitnessError]:
        return UncertainError if self.uncertain else WitnessError

    def asks(self, name: str, operation: str, epoch: int = 1) -> str:
        return self.witness.handle(name, operation, epoch, "b" if name == "a" else "a")

    def expired(self) -> "Robot":
        self.now += EXPIRY
        return self


def granted() -> Robot:
    robot = Robot().expired()
    assert robot.asks("a", "claim") == ""
    return robot
