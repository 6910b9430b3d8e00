"""What the appliance did over the last hour, in samples: counters that only grow, for whoever draws their rates.

Control is asked for its measures every `BUSY_SECONDS` while somebody follows and every `IDLE_SECONDS` otherwise, once
for everybody: how many look at it costs RVMaster nothing. What is kept is bounded by time and number.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from typing import Annotated, NamedTuple

import msgspec

from appliance.api.control import ControlAwayError, ControlLink
from appliance.channel.admin import MetricsWanted
from appliance.channel.answers.field_docs import Moment, told
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.status import Status

BUSY_SECONDS = 2.0
IDLE_SECONDS = 10.0
LEAST_SECONDS = 0.2
_KEPT_SECONDS = 3600.0
_MOST = 1800
_KINDS = ("verdict", "drop", "change", "fault")
_AWAY = "RVMaster does not answer"


class Sample(msgspec.Struct, frozen=True, kw_only=True):
    """Counters at one moment, since RVMaster started; after its restart they begin anew."""

    time: Moment
    allowed: Annotated[int, told("decisions of the policy")]
    denied: Annotated[int, told("decisions of the policy, `would deny` included")]
    messages: Annotated[int, told("relayed")]
    bytes: Annotated[int, told("relayed")]
    dropped: Annotated[int, told("messages that slow subscribers did not get")]
    nodes: int
    monitors: Annotated[dict[str, list[int]], told("of each monitor: verdicts, drops, changes, faults")]


class Seen(NamedTuple):
    """What control said last: its status, or why there is none."""

    number: int
    status: Status | None
    sample: Sample | None
    away: str | None


class History:
    """Takes the samples. `measures()` is control's answer to `MetricsWanted`."""

    def __init__(self, measures: Callable[[], Awaitable[Measures]]) -> None:
        self._measures = measures
        self._samples: deque[Sample] = deque(maxlen=_MOST)
        self._followers = 0
        self._sooner = asyncio.Event()
        self._news = asyncio.Condition()
        self.seen = Seen(0, None, None, _AWAY)

    def samples(self, most: int) -> list[Sample]:
        """The samples of the last hour, at most so many, evenly taken, the newest last."""
        kept = list(self._samples)
        step = -(-len(kept) // most)
        return kept[::-1][::step][::-1] if step > 1 else kept

    @contextlib.contextmanager
    def following(self) -> Iterator[None]:
        """Samples come more often while this lasts."""
        self._followers += 1
        self._sooner.set()
        try:
            yield
        finally:
            self._followers -= 1

    async def after(self, number: int) -> Seen:
        """What was seen, as soon as it is something newer than this number."""
        async with self._news:
            await self._news.wait_for(lambda: self.seen.number > number)
            return self.seen

    async def again(self, seconds: float) -> Seen:
        """What is seen by a look sooner than is due; what was seen last when that takes longer than `seconds`.

        However many ask, there is one look in `LEAST_SECONDS`.
        """
        self._sooner.set()
        with contextlib.suppress(TimeoutError):
            return await asyncio.wait_for(self.after(self.seen.number), seconds)
        return self.seen

    async def run(self) -> None:
        """Sample until cancelled."""
        while True:
            self._sooner.clear()
            await self._look()
            until = BUSY_SECONDS if self._followers else IDLE_SECONDS
            least = min(LEAST_SECONDS, until)
            await asyncio.sleep(least)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._sooner.wait(), until - least)

    async def _look(self) -> None:
        status, sample, away = None, None, None
        try:
            body = await self._measures()
            status, sample = body.status, sample_of(body, time.time())
        except ControlAwayError as error:
            away = str(error)
        if sample is not None:
            self._keep(sample)
        async with self._news:
            self.seen = Seen(self.seen.number + 1, status, sample, away)
            self._news.notify_all()

    def _keep(self, sample: Sample) -> None:
        while self._samples and self._samples[-1].time > sample.time:  # the clock was set back since
            self._samples.pop()
        while self._samples and self._samples[0].time < sample.time - _KEPT_SECONDS:
            self._samples.popleft()
        self._samples.append(sample)


async def measures_of(control: ControlLink) -> Measures:
    """Control's answer to `MetricsWanted`. Raises `ControlAwayError`."""
    answer = await control.ask(MetricsWanted(), None)
    if not answer.ok:
        raise ControlAwayError(answer.error)
    return answer.given()


def sample_of(body: Measures, now: float) -> Sample:
    """A sample out of control's answer to `MetricsWanted`."""
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
