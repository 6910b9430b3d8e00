"""Keep samples of the last hour: counters that only grow, from which clients compute rates.

One query of control serves all clients, so more clients cost RVMaster nothing.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from typing import Annotated, NamedTuple

import msgspec

from appliance.api.front.control import ControlAwayError, ControlLink
from appliance.base import clock
from appliance.channel.admin import MetricsWanted
from appliance.channel.answers.field_docs import Moment, doc
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.status import Status

BUSY_SECONDS = 2.0
IDLE_SECONDS = 10.0
LEAST_SECONDS = 0.2
_KEPT_SECONDS = 3600.0
_MAX = 1800
_KINDS = ("verdict", "drop", "change", "fault")
_AWAY = "RVMaster does not answer"


class Sample(msgspec.Struct, frozen=True, kw_only=True):
    """Counters at one time, since RVMaster started; after its restart they begin at zero."""

    time: Moment
    allowed: Annotated[int, doc("decisions of the policy")]
    denied: Annotated[int, doc("decisions of the policy, `would deny` included")]
    messages: Annotated[int, doc("relayed")]
    bytes: Annotated[int, doc("relayed")]
    dropped: Annotated[int, doc("messages dropped for slow subscribers")]
    nodes: Annotated[int, doc("number of the robot's nodes")]
    monitors: Annotated[dict[str, list[int]], doc("for each monitor: verdicts, drops, changes, faults")]


class LastSample(NamedTuple):
    """Control's last status, or the reason why it is unknown; `active` as in `ControlAwayError`."""

    number: int
    status: Status | None
    sample: Sample | None
    away: str | None
    active: str = ""


class SampleHistory:
    """Takes the samples; `measures()` returns control's answer to `MetricsWanted`."""

    def __init__(self, measures: Callable[[], Awaitable[Measures]]) -> None:
        self._measures = measures
        self._samples: deque[Sample] = deque(maxlen=_MAX)
        self._followers = 0
        self._sooner = asyncio.Event()
        self._news = asyncio.Condition()
        self.seen = LastSample(0, None, None, _AWAY)

    def samples(self, most: int) -> list[Sample]:
        kept = list(self._samples)
        step = -(-len(kept) // most)
        return kept[::-1][::step][::-1] if step > 1 else kept

    @contextlib.contextmanager
    def following(self) -> Iterator[None]:
        self._followers += 1
        self._sooner.set()
        try:
            yield
        finally:
            self._followers -= 1

    async def after(self, number: int) -> LastSample:
        async with self._news:
            await self._news.wait_for(lambda: self.seen.number > number)
            return self.seen

    async def again(self, seconds: float) -> LastSample:
        """Return a new sample, or the last one if sampling takes longer than `seconds`.

        Control is queried at most once in `LEAST_SECONDS`.
        """
        self._sooner.set()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                return await self.after(self.seen.number)
        return self.seen

    async def run(self) -> None:
        while True:
            self._sooner.clear()
            await self.look()
            until = BUSY_SECONDS if self._followers else IDLE_SECONDS
            least = min(LEAST_SECONDS, until)
            await asyncio.sleep(least)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(until - least):
                    await self._sooner.wait()

    async def look(self) -> None:
        status, sample, away, active = None, None, None, ""
        try:
            body = await self._measures()
            status, sample = body.status, sample_of(body, clock.wall())
        except ControlAwayError as error:
            away, active = str(error), error.active
        if sample is not None:
            self._keep(sample)
        async with self._news:
            self.seen = LastSample(self.seen.number + 1, status, sample, away, active)
            self._news.notify_all()

    def _keep(self, sample: Sample) -> None:
        while self._samples and self._samples[-1].time > sample.time:  # drop them: the clock was set back
            self._samples.pop()
        while self._samples and self._samples[0].time < sample.time - _KEPT_SECONDS:
            self._samples.popleft()
        self._samples.append(sample)


async def measures_of(control: ControlLink) -> Measures:
    answer = await control.ask(MetricsWanted(), None)
    if not answer.ok:
        raise ControlAwayError(answer.error, answer.active)
    return answer.unwrap()


def sample_of(body: Measures, now: float) -> Sample:
    decided = {"allow": 0, "deny": 0, "would deny": 0}
    for _category, outcome, count in body.decisions:
        decided[outcome] = decided.get(outcome, 0) + count
    rows = list(body.relayed.values())
    monitors: dict[str, list[int]] = {}
    for kind, name, count in body.monitors:
        if kind in _KINDS:
            monitors.setdefault(name, [0] * len(_KINDS))[_KINDS.index(kind)] = count
    return Sample(
        time=now,
        allowed=decided["allow"],
        denied=decided["deny"] + decided["would deny"],
        messages=sum(row[0] for row in rows),
        bytes=sum(row[1] for row in rows),
        dropped=sum(row[2] for row in rows),
        nodes=body.nodes["live"],
        monitors=monitors,
    )
