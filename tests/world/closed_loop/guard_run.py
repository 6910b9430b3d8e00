"""A guard that runs in the product's own engine, in virtual time."""

import functools
from collections.abc import Callable, Iterator, Mapping

from appliance.features.guards.presets import Guard, preset_named, text_of
from rosmop.check.sources import compiled_from
from rosmop.fast.abi import SetPart
from rosmop.fast.build import certified, parts_of
from rosmop.fast.serialization import decoded_part
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import MessageSender, Outcome
from roswire.standard import standard_definitions
from tests.world.closed_loop.messages import EPOCH

Change = Callable[[str], str]
Value = bool | int | float | str
DEFINITIONS = standard_definitions()
NODES = ("", "/a", "/b", "/c", "/d", "/e", "/f")
MS = 10**6


def unchanged(text: str) -> str:
    return text


@functools.cache
def parameters_of(preset: str) -> frozenset[str]:
    return frozenset(one.name for one in preset_named(preset).parameters)


@functools.lru_cache(maxsize=256)
def _part(text: str) -> SetPart:
    [part] = parts_of(certified(compiled_from({"guard.rv": text}, DEFINITIONS)).data, [(("guard",), ())])
    return decoded_part(part)


def _ns(at: int) -> int:
    return EPOCH * 10**9 + at * MS


class RunningGuard:
    """A guard of a preset with these values; `change` makes another text of it. Times are ms."""

    def __init__(
        self, preset: str, types: Mapping[str, str], values: Mapping[str, Value], change: Change = unchanged
    ) -> None:
        chosen = preset_named(preset)
        in_text = {name: str(value) for name, value in values.items() if chosen.parameter(name).loads}
        self._given = {name: value for name, value in values.items() if name not in in_text}
        self._part = _part(change(text_of(Guard("guard", chosen, types=types, values=in_text))))
        self.topics = chosen.given_topics
        self._monitors = self._set()
        self.now = 0
        self._monitors.start(_ns(0))

    def _set(self) -> MonitorSet:
        monitors = MonitorSet.of(self._part.compiled, fast=WasmFastPath(self._part.module))
        monitors.name_senders(lambda source: (f"10.0.0.{source}", NODES[source]))
        monitors.give({"guard": self._given})
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
        outcome = self._monitors.judge(topic, bytearray(data), _ns(at), MessageSender(node))
        sent = [one for before in outcome.before for one in self._sent(before)]
        passed = None if outcome.result == "dropped" else bytes(outcome.buffer)
        return passed, [*sent, *self._sent(outcome)]

    @staticmethod
    def _sent(outcome: Outcome) -> Iterator[tuple[int, str, bytes]]:
        for one in outcome.sent():
            if not one.is_call:
                yield (outcome.time - _ns(0)) // MS, one.topic, bytes(one.data)

    @property
    def holds(self) -> bool:
        return self._monitors.monitor("guard").held

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
