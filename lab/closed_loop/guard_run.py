"""A guard that runs in the product's own engine, in virtual time."""

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from appliance.features.guards.presets import preset_named
from lab.closed_loop.messages import EPOCH
from rosmop.run.engine import MonitorSet
from rosmop.run.fast_path import BatchOptions, FastLane
from rosmop.run.outcomes import MessageSender, Outcome
from tests.support.features.guards.running_guard import Change, Value, on_its_module, part_with, unchanged

NODES = ("", "/a", "/b", "/c", "/d", "/e", "/f", "/g")
MS = 10**6


@functools.cache
def parameters_of(preset: str) -> frozenset[str]:
    return frozenset(parameter.name for parameter in preset_named(preset).parameters)


@dataclass(frozen=True)
class Beside:
    """A second guard of the same topic, before or behind the one of the world, unless its text has an order."""

    name: str
    text: str
    given: Mapping[str, Value]
    first: bool


def _ns(at: int) -> int:
    return EPOCH * 10**9 + at * MS


class RunningGuard:
    """A guard of a preset with these values; `change` makes another text of it. Times are ms."""

    def __init__(
        self,
        preset: str,
        types: Mapping[str, str],
        values: Mapping[str, Value],
        change: Change = unchanged,
        beside: Beside | None = None,
    ) -> None:
        before = () if beside is None or not beside.first else (beside.text,)
        behind = () if beside is None or beside.first else (beside.text,)
        self._part, given = part_with(preset, types, values, change, before=before, behind=behind)
        self._given = {"guard": given, **({} if beside is None else {beside.name: dict(beside.given)})}
        self.topics = preset_named(preset).given_topics
        self._monitors = self._set()
        self.now = 0
        self._monitors.start(_ns(0))

    def _set(self) -> MonitorSet:
        monitors = on_its_module(self._part)
        monitors.name_senders(lambda source: (f"10.0.0.{source}", NODES[source]))
        monitors.give(self._given)
        return monitors

    def advance(self, at: int) -> Iterator[tuple[int, str, bytes]]:
        """Yield the time, topic and bytes of each message that is due from the guard."""
        self.now = at
        due = self._monitors.next_due
        if due is not None and due <= _ns(at):
            for one in self._monitors.advance(_ns(at)):
                yield from self._sent(one)

    def tell(
        self, topic: str, data: bytes, at: int, node: int
    ) -> tuple[bytes | None, list[tuple[int, str, bytes]]]:
        """Return the message as it goes on, or None if it was dropped, and the messages that the guard sends."""
        outcome = self._judge(topic, bytearray(data), _ns(at), MessageSender(node))
        sent = [one for before in outcome.before for one in self._sent(before)]
        passed = None if outcome.result == "dropped" else bytes(outcome.buffer)
        return passed, [*sent, *self._sent(outcome)]

    def _judge(self, topic: str, data: bytearray, now: int, sender: MessageSender) -> Outcome:
        """Process a message as a relay does once it has reported the first changes: also changes stay in the module."""
        found = self._monitors.process_fast(topic, data, now, lambda lane: self._options(lane, sender.source))
        return self._monitors.process(topic, data, now, sender) if found is None else found

    @staticmethod
    def _options(lane: FastLane, source: int) -> BatchOptions:
        return lane.prepare(loud=False, told=[True] * len(lane.events), source=source)

    @staticmethod
    def _sent(outcome: Outcome) -> Iterator[tuple[int, str, bytes]]:
        for message in outcome.sent_messages():
            if not message.is_call:
                yield (outcome.time - _ns(0)) // MS, message.topic, bytes(message.data)

    @property
    def holds(self) -> bool:
        return self._monitors.monitor("guard").held

    def give(self, name: str, value: Value) -> None:
        """Set a value of the running guard."""
        self._given["guard"][name] = value
        self._monitors.give(self._given)

    def hold(self) -> None:
        self._monitors.hold(self._monitors.monitor("guard"), "the rig asks for it")

    def resume(self) -> None:
        self._monitors.resume("guard")

    def switch(self, at: int, *, enabled: bool) -> None:
        self._monitors.switch({"guard": enabled}, _ns(at))

    def restart(self, at: int, *, lost: bool) -> None:
        """Replace the process: with the state that it kept, or after it was lost."""
        kept = [
            (one.names, one.layout, one.base(), one.cells() or None) for one in self._monitors.kept_groups()
        ]
        self._monitors = self._set()
        self._monitors.recover(
            [] if lost else kept, {"": "power cut"} if lost else {}, _ns(at), restarted=True
        )

    def stand_by(self) -> None:
        """Send no safe message before the first command, as no guard may do after a restart."""
        self._monitors.monitor("guard").starting.clear()
