"""Run the recorder process: its lifeline, its link to control, and a thread that does the work.

The process has no network. It outlives control; its reports wait in the recording store.
"""

import asyncio
import mmap
import os
import socket
from pathlib import Path

import msgspec

from appliance.base.age_clock import AgeClock
from appliance.channel import messages
from appliance.channel.channel import Channel
from appliance.channel.child_process import Child
from appliance.configuration.settings import Settings, load_resolved
from appliance.features.recorder import recorder_link
from appliance.features.recorder.recorder import Recorder
from appliance.features.recorder.recorder_link import RingTerms
from appliance.features.recorder.recording_store import RecordingStore
from appliance.features.recorder.settings import RecorderRules

_DAY = 86_400.0


def main(lifeline_fd: int, config: Path) -> None:
    asyncio.run(_Process(load_resolved(config), lifeline_fd).run())


class _Process:
    def __init__(self, settings: Settings, lifeline_fd: int) -> None:
        self._settings = settings
        self._child = Child(
            Channel(socket.socket(fileno=lifeline_fd), messages.Lifeline),
            recorder_link.RecorderLink,
            said=self._hear,
            linked=lambda: self._hear(recorder_link.RecordingsAsked()),
            memory_given=self._memory_given,
        )
        self._rings: dict[int, memoryview] = {}
        self._memory = self._ahead = 0
        self._said: list[object] = []
        self._wake = asyncio.Event()

    async def run(self) -> None:
        self._child.attach(messages.Ready())
        ended = asyncio.ensure_future(self._child.ended.wait())
        recorder: Recorder | None = None
        while not ended.done():
            if len(self._rings) == self._settings.relays:
                if recorder is None:
                    recorder = await asyncio.to_thread(self._make_recorder)
                said, self._said = self._said, []
                for message in await asyncio.to_thread(recorder.step, said):
                    self._child.tell(message)
            woken = asyncio.ensure_future(self._wake.wait())
            pause = recorder.pause if recorder is not None else None
            await asyncio.wait((ended, woken), timeout=pause, return_when=asyncio.FIRST_COMPLETED)
            woken.cancel()
            self._wake.clear()
        if recorder is not None:
            recorder.close()

    def _make_recorder(self) -> Recorder:
        age = AgeClock(Path.cwd() / "age")
        settings, rules = self._settings, self._settings.of(RecorderRules)
        return Recorder(
            rules,
            RecordingStore(
                Path.cwd(),
                disk=int(rules.disk),
                reserve=int(settings.audit.reserve_bytes),
                seconds=None if rules.days is None else rules.days * _DAY,
                clock=age,
                dated=age.true_date,
            ),
            settings.state / "control" / "audit.db",
            [ring for _index, ring in sorted(self._rings.items())],
            memory=self._memory,
            ahead=self._ahead,
        )

    def _hear(self, message: object) -> None:
        self._said.append(message)
        self._wake.set()

    def _memory_given(self, message: messages.MemoryGiven, descriptor: int) -> None:
        given = msgspec.convert(message.terms, RingTerms)
        self._rings[given.index] = memoryview(mmap.mmap(descriptor, 0, prot=mmap.PROT_READ))
        self._memory, self._ahead = given.since, given.ahead  # equal in all rings
        os.close(descriptor)
        self._wake.set()
