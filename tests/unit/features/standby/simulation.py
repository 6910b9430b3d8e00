"""Deterministic simulation of two appliances and the robot, with the product's own witness, lease and datagrams.

    python -m tests.unit.features.standby.simulation SEED HISTORIES [--trace]

A history is a random sequence of faults of links, processes, disks and power in virtual time. Each process has a
clock with its own speed. These promises are checked after every step:

1. The robot admits at most one appliance, and translates its fixed address only to that one.
2. At most one appliance is active.
3. An appliance that becomes active has every acknowledged write, and a greater epoch than all before.
4. A grant is answered only when the robot admits its holder.
5. Within ten seconds after the last fault, one appliance is active and admitted, and both are in sync. If one link
   stays cut, one is active and admitted if an appliance in sync reaches the robot.
"""

import argparse
import heapq
import random
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, partial
from types import ModuleType
from typing import Any

from appliance.features.standby import lease, process
from appliance.features.standby.witness.firewall import LeaseFirewall
from appliance.features.standby.witness.lease_file import LeaseRecord
from appliance.features.standby.witness.one_file import witness_program
from appliance.features.standby.witness.protocol import ANSWER, REQUEST, Left, unseal
from tests.unit.features.standby.witness.robot import BOTH, KEYS, PAIR_SETTINGS

TICK = 0.1
HEALED = 10.0  # seconds after the last fault
DRIFT = 0.03
_INBOX = 64


class Violation(AssertionError):  # noqa: N818  it is a finding
    pass


class _PowerLost(Exception):  # noqa: N818  it is an event
    pass


def module_of(text: str, name: str) -> ModuleType:
    module = ModuleType(name)
    exec(compile(text, name, "exec"), module.__dict__)  # noqa: S102  the program as it is delivered, and its mutants
    return module


@cache
def delivered_witness() -> ModuleType:
    return module_of(witness_program(), "witness")


@dataclass(frozen=True)
class Product:
    witness: ModuleType = field(default_factory=delivered_witness)
    lease: ModuleType = lease


@dataclass(frozen=True)
class LogCopy:
    epoch: int
    entries: tuple[str, ...]


@dataclass(frozen=True)
class LogStored:
    epoch: int
    number: int


@dataclass
class Net:
    cut: int = 0
    loss: float = 0.0
    duplicates: float = 0.0  # the second copy comes seconds later, as if an attacker had kept it
    late: float = 0.0
    delay: float = 0.01


class Host:
    def __init__(self, history: "History", name: str) -> None:
        self.history = history
        self.name = name
        self.speed = 1 + history.random.uniform(-DRIFT, DRIFT)
        self.offset = history.random.uniform(0, 1000)
        self.up = False
        self.life = self._timer = 0
        self.paused_until = 0.0
        self.inbox: list[tuple[str, Any]] = []

    @property
    def now(self) -> float:
        return self.offset + self.history.now * self.speed

    @property
    def running(self) -> bool:
        return self.up and self.history.now >= self.paused_until

    def start(self) -> None:
        if not self.up:
            self.up = True
            self.life += 1
            self.history.trace(f"started {self.name}")
            self.started()
            self._wake(self.life, self._timer)

    def crash(self) -> None:
        if self.up:
            self.up = False
            self.inbox.clear()
            self.paused_until = 0.0
            self.crashed()
            self.history.trace(f"crashed {self.name}")

    def pause(self, seconds: float) -> None:
        self.paused_until = max(self.paused_until, self.history.now + seconds)

    def take(self, sender: str, message: Any) -> None:
        if self.running:
            self.received(sender, message)
        elif self.up and len(self.inbox) < _INBOX:
            self.inbox.append((sender, message))

    def resume(self) -> None:
        if self.up:
            self.paused_until = self.history.now
            self._timer += 1
            self._wake(self.life, self._timer)

    def _wake(self, life: int, timer: int) -> None:
        if not self.up or life != self.life or timer != self._timer:
            return
        if self.running:
            waiting, self.inbox = self.inbox, []
            for sender, message in waiting:
                if self.up and life == self.life:
                    self.received(sender, message)
            if self.up and life == self.life:
                self.tick()
        due = max(TICK * self.history.random.uniform(0.5, 1), self.paused_until - self.history.now)
        self.history.at(due, lambda: self._wake(life, timer))

    def started(self) -> None: ...
    def crashed(self) -> None: ...
    def tick(self) -> None: ...
    def received(self, sender: str, message: Any) -> None: ...


class SimulatedAppliance(Host):
    def __init__(self, history: "History", name: str) -> None:
        super().__init__(history, name)
        self.other = "b" if name == "a" else "a"
        self.log: tuple[str, ...] = ()
        self.log_epoch = self.epoch = 0
        self.lease: Any = None
        self.was_active = 0

    def started(self) -> None:
        session = f"{self.history.random.getrandbits(64):x}"
        self.lease = self.history.product.lease.ApplianceLease(
            self.name, self.other, session, self.epoch, self.now
        )
        self.channel = process.WitnessChannel(self.name, KEYS[self.name], session)
        self.stored = -1
        self.stored_epoch = 0
        self.pending: list[tuple[int, float]] = []  # length of the log with the entry, time

    def crashed(self) -> None:
        self.note_activity()

    @property
    def active(self) -> bool:
        return self.running and self.lease.is_active(self.now)

    def tick(self) -> None:
        if self.lease.is_active(self.now):
            self._send_log()
        else:
            self.pending.clear()
        waiting = self.pending[0][1] if self.pending else None
        caught_up = self.stored_epoch == self.lease.held and self.stored == len(self.log)
        self._send(self.lease.tick(self.now, waiting_since=waiting, caught_up=caught_up))
        self._answer()

    def write(self) -> None:
        if self.active and len(self.pending) < _INBOX:
            self._own_log()
            self.log = (*self.log, self.history.next_write())
            self.pending.append((len(self.log), self.now))
            self._send_log()
            self._answer()

    def switch_over(self) -> None:
        if self.running:
            with suppress(self.history.product.lease.LeaseError):
                self._send(self.lease.switch_over(self.now))

    def received(self, sender: str, message: Any) -> None:
        if sender == "witness":
            answer = self.channel.read(message)
            if answer is not None:
                self._send(self.lease.answered(*answer))
        elif isinstance(message, LogCopy):
            if self.lease.follow(message.epoch):
                newer = message.epoch > self.log_epoch
                if newer or len(message.entries) >= len(self.log):
                    self.log, self.log_epoch = message.entries, message.epoch
                    self.history.send(self.name, self.other, LogStored(message.epoch, len(self.log)))
        elif isinstance(message, LogStored):
            if message.epoch == self.lease.held:
                self.stored = max(self.stored if self.stored_epoch == message.epoch else -1, message.number)
                self.stored_epoch = message.epoch
        else:
            if isinstance(message, self.history.product.lease.ClaimPromise):
                self.history.trace(f"promised {self.other} to {self.name}")
            self._send(self.lease.received(self.now, message))
        self.epoch = self.lease.epoch
        self._answer()

    def note_activity(self) -> None:
        epoch = self.lease.held if self.active else 0
        if epoch != self.was_active:
            if epoch:
                self.history.became_active(self, epoch)
            else:
                self.history.trace(f"passive {self.name}")
            self.was_active = epoch

    def _own_log(self) -> None:
        self.log_epoch = self.epoch = self.lease.held

    def _send_log(self) -> None:
        self._own_log()
        self.history.send(self.name, self.other, LogCopy(self.lease.held, self.log))

    def _answer(self) -> None:
        while self.pending:
            length, _ = self.pending[0]
            stored = self.stored_epoch == self.lease.held and self.stored >= length
            if not (self.lease.is_active(self.now) and (stored or self.lease.answers_alone)):
                return
            self.history.acknowledged(self, self.log[length - 1])
            del self.pending[0]

    def _send(self, messages: Any) -> None:
        for message in messages:
            if isinstance(message, self.history.product.lease.WitnessRequest):
                self.history.send(self.name, "witness", self.channel.write(message))
            else:
                self.history.send(self.name, self.other, message)


class SimulatedRobot(Host):
    def __init__(self, history: "History") -> None:
        super().__init__(history, "witness")
        self.disk = LeaseRecord(1, "", BOTH, "")
        self.boot = 0
        self.rules = ""
        self.network_up = False
        self.disk_full = self.firewall_fails = False
        self.save_fault = ""
        self.granted = self.disk.epoch
        self.gate: Any = None
        self.answering = False
        self.spent = 0.0  # seconds that programs of the firewall have taken in the present step
        self.firewall = LeaseFirewall(PAIR_SETTINGS, "nft", self._nft)

    def started(self) -> None:
        """Start the witness. After a boot, the boot rule has run before the network is up."""
        product = self.history.product.witness
        if not self.network_up:
            self.boot += 1
            self.firewall_fails = False
            self.firewall = product.LeaseFirewall(PAIR_SETTINGS, "nft", self._nft)
            self.firewall.admit("")
            self.network_up = True
        try:
            self.keeper = product.Witness(
                record=self.disk,
                save=self._save,
                admit=self.firewall.admit,
                boot=str(self.boot),
                clock=lambda: self.now,
            )
        except product.WitnessError:
            self.crash()
            return
        nonce = f"{self.history.random.getrandbits(64):x}"
        self.gate = product.WitnessGate(self.keeper, PAIR_SETTINGS.appliances, nonce)

    def crash(self) -> None:
        super().crash()
        self.history.at(self.history.random.uniform(0.05, 1), self.start_if_booted)

    def start_if_booted(self) -> None:
        if self.network_up:
            self.start()

    def power_off(self) -> None:
        super().crash()
        self.network_up = False
        self.rules = ""

    def tick(self) -> None:
        """Settle the lease as the program does."""
        if self.keeper.unsettled:
            try:
                self.keeper.settle()
            except self.history.product.witness.WitnessError:
                return
            except _PowerLost:
                self._lose_power()

    def _lose_power(self) -> None:
        self.power_off()
        self.history.at(self.history.random.uniform(0.5, 5), self.start)

    @property
    def now(self) -> float:
        return super().now + self.spent * self.speed

    def received(self, sender: str, message: Any) -> None:
        """Answer. A slow program of the firewall delays its change, the answer, and what comes next."""
        self.answering = True
        try:
            answer = self.gate.answer(message, PAIR_SETTINGS.appliances[sender].address)
        except _PowerLost:
            self.spent = 0.0
            self._lose_power()
            return
        finally:
            self.answering = False
        spent, self.spent = self.spent, 0.0
        if spent:
            self.pause(spent)
            self.history.at(spent, partial(self._answer_later, self.life, sender, message, answer))
        else:
            self._answer(sender, message, answer)

    def _answer_later(self, life: int, sender: str, message: Any, answer: bytes | None) -> None:
        if self.up and life == self.life:
            self._answer(sender, message, answer)

    def _answer(self, sender: str, message: Any, answer: bytes | None) -> None:
        if answer is not None:
            self._trace(sender, message, answer)
            self.history.send("witness", sender, answer)

    def _trace(self, sender: str, message: bytes, answer: bytes) -> None:
        request = unseal(REQUEST, KEYS[sender], message)
        said = unseal(ANSWER, KEYS[sender], answer)
        if request is None or said is None or "stale" in said or request["do"] == "look":
            return
        other = "b" if sender == "a" else "a"
        by = f"by {sender} {request['epoch']}"
        if not said["ok"]:
            self.history.trace(f"refused {sender} {said['reason']}")
        elif request["do"] == "claim":
            self.history.require(said["epoch"] > self.granted, f"granted epoch {said['epoch']} twice")
            self.granted = said["epoch"]
            self.history.require(self.admitted() == {sender}, f"granted {sender} without its firewall rules")
            self.history.trace(f"granted {sender} {said['epoch']}")
        elif request["do"] in ("renew", "release"):
            self.history.trace(
                f"{request['do']}{'ed' if request['do'] == 'renew' else 'd'} {sender} {said['epoch']}"
            )
        else:
            self.history.trace(f"{request['do'].rstrip('e')}ed {other} {by}")

    def admitted(self) -> set[str]:
        shut = {
            name
            for name, appliance in PAIR_SETTINGS.appliances.items()
            if f"ip saddr {appliance.address} drop" in self.rules
        }
        return set(BOTH) - shut

    def translated_to(self) -> set[str]:
        return set(re.findall(r"dnat to (\S+)", self.rules))

    def _change(self, rules: str) -> None:
        if not self.history.slow or not self.answering:  # before the network or the process is up
            self.rules = rules
            return
        self.spent += self.history.slow * self.history.random.uniform(0.5, 1.5)
        boot = self.boot
        self.history.at(self.spent, lambda: self._changed(boot, rules))

    def _changed(self, boot: int, rules: str) -> None:
        if self.network_up and boot == self.boot:
            self.rules = rules

    def _save(self, record: Any) -> None:
        fault, self.save_fault = self.save_fault, "broken" if self.save_fault == "broken" else ""
        if self.disk_full:
            raise self.history.product.witness.WitnessError("the disk is full")
        if fault in ("uncertain", "broken"):
            self.disk = self.history.random.choice([self.disk, record])
            raise self.history.product.witness.UncertainError("input/output error")
        self.disk = record
        if fault == "power":
            raise _PowerLost

    def _nft(self, command: list[str], text: str, _left: Left) -> str:
        if command[1] == "-f":
            fails, product = self.firewall_fails, self.history.product.witness
            if fails and self.history.random.random() < 0.5:
                raise product.WitnessError("nft: cannot allocate memory")
            if not fails or self.history.random.random() < 0.5:
                self._change(text)
            if fails:
                raise product.UncertainError("nft: timed out")
        return self.rules


@dataclass
class History:
    seed: int
    product: Product = field(default_factory=Product)
    on_event: Callable[[str], None] | None = None
    faults: tuple[str, ...] = ()
    slow: float = 0.0
    """Seconds that a change of the robot's firewall takes."""

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)  # noqa: S311  a seeded history, not a secret
        self.now = 0.0
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._count = self._writes = 0
        self.greatest = 0
        self._healed = False
        self.answered: set[str] = set()
        self.links = {(one, two): Net() for one in (*BOTH, "witness") for two in (*BOTH, "witness")}
        self.appliances = {name: SimulatedAppliance(self, name) for name in BOTH}
        self.robot = SimulatedRobot(self)
        self._focus = self.random.sample([*BOTH, "witness"], 2)  # a link that fails more often
        self.hosts: dict[str, Host] = {**self.appliances, "witness": self.robot}
        self._kinds: dict[str, Callable[[], float]] = {
            "partition": self._partition,
            "link of the appliances": lambda: self._lose_link("a", "b"),
            "witness link": lambda: self._lose_link(
                self.random.choice([self._active().name, *BOTH]), "witness"
            ),
            "bad link": self._bad_link,
            "flapping": self._flapping,
            "pause": self._pause,
            "pause of the active": lambda: self._pause(self._active()),
            "crash": self._crash,
            "crash of the active": lambda: self._crash(self._active()),
            "reboot": self._reboot,
            "power cut": self._power_cut,
            "full disk": self._full_disk,
            "broken save": self._broken_save,
            "firewall": self._firewall_failure,
            "switchover": self._switch_over,
        }

    def trace(self, event: str) -> None:
        if self.on_event is not None:
            self.on_event(event)

    def at(self, seconds: float, action: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._queue, (self.now + seconds, self._count, action))

    def require(self, condition: bool, text: str) -> None:
        if not condition:
            raise Violation(f"seed {self.seed}, {self.now:.3f} s: {text}")

    def next_write(self) -> str:
        self._writes += 1
        return str(self._writes)

    def acknowledged(self, appliance: SimulatedAppliance, entry: str) -> None:
        self.answered.add(entry)
        self.trace(f"acknowledged {appliance.name} {entry}")

    def became_active(self, appliance: SimulatedAppliance, epoch: int) -> None:
        self.trace(f"active {appliance.name} {epoch}")
        self._require_answered(appliance)
        self.require(epoch >= self.greatest, f"{appliance.name} is active with the old epoch {epoch}")
        self.greatest = epoch

    def _require_answered(self, appliance: SimulatedAppliance) -> None:
        lost = self.answered - set(appliance.log)
        self.require(not lost, f"{appliance.name} is active without the answered writes {sorted(lost)[:5]}")

    def send(self, sender: str, receiver: str, message: Any) -> None:
        net = self.links[sender, receiver]
        if net.cut or self.random.random() < net.loss:
            return
        copies = 2 if self.random.random() < net.duplicates else 1
        for copy in range(copies):
            delay = self.random.uniform(0.001, net.delay)
            if copy or self.random.random() < net.late:
                delay += self.random.uniform(0.0, 6.0)
            self.at(delay, lambda: None if net.cut else self.hosts[receiver].take(sender, message))

    def run(self) -> "History":
        for host in self.hosts.values():
            self.at(self.random.uniform(0, 0.5), host.start)
        self._client()
        until = self.random.uniform(2, 5)
        # Few kinds of faults in a history, but often: so they meet one another more often than if all were mixed.
        kinds = self.faults or self.random.sample(sorted(self._kinds), self.random.randint(2, 5))
        for _ in range(self.random.randint(2, 25)):
            self._turn_until(until)
            until += self._kinds[self.random.choice(kinds)]()
        self._turn_until(until)
        cut = self.random.choice([(), (), (), ("a", "b"), ("a", "witness"), ("b", "witness")])
        self._heal(cut)
        self._turn_until(self.now + HEALED)
        active = {name for name, appliance in self.appliances.items() if appliance.active}
        reaching = set(BOTH) - (set(cut) if "witness" in cut else set())
        self.require(
            (len(active) == 1 and self.robot.admitted() == active <= reaching)
            or not reaching & set(self.robot.disk.in_sync),
            f"after {HEALED:.0f} s {active or 'no appliance'} is active, {self.robot.admitted() or 'none'} admitted",
        )
        for name in active:
            self._require_answered(self.appliances[name])
        if not cut:
            self.require(
                set(self.robot.disk.in_sync) == set(BOTH), f"only {self.robot.disk.in_sync} is in sync"
            )
        return self

    def _turn_until(self, end: float) -> None:
        while self._queue and self._queue[0][0] <= end:
            self.now, _, action = heapq.heappop(self._queue)
            action()
            self._check()
        self.now = end

    def _check(self) -> None:
        for appliance in self.appliances.values():
            if appliance.lease is not None:
                appliance.note_activity()
        active = [name for name, one in self.appliances.items() if one.lease is not None and one.active]
        self.require(len(active) <= 1, "both appliances are active")
        if self.robot.network_up:
            admitted = self.robot.admitted()
            self.require(len(admitted) <= 1, "the robot admits both appliances")
            targets = {PAIR_SETTINGS.appliances[name].address for name in admitted}
            self.require(
                self.robot.translated_to() == targets, "the fixed address leads to another appliance"
            )

    def _client(self) -> None:
        for appliance in self.appliances.values():
            if self.random.random() < 0.5:
                appliance.write()
        self.at(self.random.uniform(0.05, 0.6), self._client)

    def _heal(self, cut: tuple[str, ...]) -> None:
        self._healed = True
        for ends, net in self.links.items():
            net.cut, net.delay = int(set(ends) == set(cut)), 0.02
            net.loss = net.duplicates = net.late = 0.0
        self.robot.disk_full = self.robot.firewall_fails = False
        self.robot.save_fault = ""
        for host in self.hosts.values():
            host.start()
            host.resume()

    def _short(self) -> float:
        return self.random.choice([0.05, 0.1, 0.3, 0.5, 1.0, 1.5, 3.0]) * self.random.uniform(0.5, 1.5)

    def _pairs(self) -> list[tuple[str, str]]:
        one, two = self._focus if self.random.random() < 0.5 else self.random.sample([*BOTH, "witness"], 2)
        pairs = [(one, two)]
        if self.random.random() < 0.7:
            pairs.append((two, one))
        if self.random.random() < 0.2:  # one host is alone
            pairs = [pair for pair in self.links if one in pair]
        return pairs

    def _cut(self, pairs: list[tuple[str, str]], change: int) -> None:
        for pair in pairs if not self._healed else ():
            self.links[pair].cut += change

    def _partition(self) -> float:
        pairs, seconds = self._pairs(), self._short()
        self._cut(pairs, 1)
        self.at(seconds, lambda: self._cut(pairs, -1))
        return self._short()

    def _lose_link(self, one: str, two: str) -> float:
        pairs, seconds = [(one, two), (two, one)], self.random.uniform(0.5, 4)
        self._cut(pairs, 1)
        self.at(seconds, lambda: self._cut(pairs, -1))
        return self._short()

    def _flapping(self) -> float:
        pairs = self._pairs()
        for number in range(self.random.randint(3, 15)):
            start = number * self.random.uniform(0.1, 1)
            self.at(start, lambda: self._cut(pairs, 1))
            self.at(start + self.random.uniform(0.05, 0.8), lambda: self._cut(pairs, -1))
        return self._short()

    def _bad_link(self) -> float:
        for pair in self._pairs():
            net = self.links[pair]
            net.loss = self.random.choice([0, 0.3, 0.7])
            net.duplicates = self.random.choice([0, 0.5])
            net.late = self.random.choice([0, 0.2, 0.6])
            net.delay = self.random.choice([0.01, 0.01, 0.3, 2.0])
        return self._short()

    def _pause(self, host: Host | None = None) -> float:
        host = host or self.hosts[self.random.choice(list(self.hosts))]
        seconds = self.random.uniform(60, 240) if self.random.random() < 0.05 else self._short()
        host.pause(seconds)
        return self.random.choice([self._short(), seconds + self._short()])

    def _active(self) -> "SimulatedAppliance":
        found = [one for one in self.appliances.values() if one.lease is not None and one.active]
        return found[0] if found else self.appliances[self.random.choice(BOTH)]

    def _crash(self, host: Host | None = None) -> float:
        host = host or self.hosts[self.random.choice(list(self.hosts))]
        host.crash()
        self.at(self._short(), host.start if host is not self.robot else self.robot.start_if_booted)
        return self._short()

    def _reboot(self) -> float:
        self.trace("rebooted witness")
        self.robot.power_off()
        self.at(self._short(), self.robot.start)
        return self._short()

    def _power_cut(self) -> float:
        self.robot.power_off()
        for appliance in self.appliances.values():
            appliance.crash()
        for host in self.hosts.values():
            self.at(self._short(), host.start)
        return self._short()

    def _full_disk(self) -> float:
        self.robot.disk_full = not self.robot.disk_full
        return self._short()

    def _firewall_failure(self) -> float:
        self.robot.firewall_fails = not self.robot.firewall_fails
        return self._short()

    def _broken_save(self) -> float:
        self.robot.save_fault = self.random.choice(["uncertain", "power", "broken"])
        if self.robot.save_fault == "broken":
            self.at(self._short(), self._repair_disk)
        return self._short()

    def _repair_disk(self) -> None:
        self.robot.save_fault = ""

    def _switch_over(self) -> float:
        self._active().switch_over()
        return self._short()


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description="Simulate the lease of two appliances.")
    parser.add_argument("seed", type=int)
    parser.add_argument("histories", type=int)
    parser.add_argument("--trace", action="store_true")
    chosen = parser.parse_args(arguments)
    broken = 0
    counts: dict[str, int] = {}
    for seed in range(chosen.seed, chosen.seed + chosen.histories):

        def note(event: str) -> None:
            kind = event.partition(" ")[0]
            counts[kind] = counts.get(kind, 0) + 1
            if chosen.trace:
                sys.stdout.write(event + "\n")

        try:
            History(seed, on_event=note).run()
        except Violation as violation:
            broken += 1
            sys.stdout.write(f"{violation}\n")
    events = ", ".join(f"{kind} {number:,}" for kind, number in sorted(counts.items()))
    sys.stdout.write(f"{chosen.histories} histories, {broken} broke a promise; events: {events}\n")
    return min(broken, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
