"""Schedules of people, programs, losses and restarts, judged by an oracle that only scans what has been heard."""

import random
from dataclasses import dataclass, field

import pytest

from appliance.channel.messages.relay_link import RankPlace
from appliance.relay.ranked_topic import (
    LISTEN_MOST_SECONDS,
    LISTEN_SECONDS,
    LOST_SECONDS,
    SETTLE_SECONDS,
    RankDriver,
    RankedTopic,
)
from tests.support.examples import seeds_of_night

FREE = 0.3
STEP = 0.01
CHECK = 0.03
RANKS = {"pad": 0, "web": 1, "tablet": 1, "planner": 2}
START = 1000.0
_NEW = RankPlace(0, FREE)
_CALM = RankPlace(0, FREE, standing="free")


def topic(known: RankPlace = _CALM, now: float = START, *, listens: bool = False) -> RankedTopic:
    """Return a topic whose publishers are connected, and that has listened before `now`."""
    made = RankedTopic(known, now if listens else now - LISTEN_MOST_SECONDS, lambda _driver: None)
    for key, rank in RANKS.items():
        made.place(key, rank, FREE)
        made.opened(key, now if listens else now - LISTEN_MOST_SECONDS)
    if not listens:
        settle(made, now - LISTEN_MOST_SECONDS)
    return made


def settle(it: RankedTopic, since: float) -> float:
    """Let the time pass after which a message is certainly newer than a hand-back."""
    steps = 4
    for step in range(steps + 1):
        it.expire(since + step / steps * SETTLE_SECONDS)
    return since + SETTLE_SECONDS


def let_go(it: RankedTopic, zero: float, since: float = 0.0) -> None:
    """Let the free time after a driver's zero pass; until `since`, the process pauses."""
    for step in range(round((FREE - since) / STEP)):
        it.expire(zero + since + step * STEP)


def test_a_gamepad_drives_while_it_moves() -> None:
    """The whole story of a gamepad, once."""
    it, now = topic(), START
    assert it.passes("planner", moves=True, now=now)
    assert not it.passes("pad", moves=False, now=now), "the zero of a gamepad at rest"
    assert it.passes("pad", moves=True, now=now)
    assert not it.passes("planner", moves=True, now=now)
    assert it.passes("pad", moves=False, now=now + 1)
    let_go(it, now + 1)
    assert not it.passes("planner", moves=True, now=now + 1 + FREE - 0.001)
    assert it.passes("planner", moves=True, now=now + 1 + FREE), "the relay has read on in the free time"


def test_messages_that_waited_in_a_pause_of_the_relay_are_older_than_the_hand_back() -> None:
    """It is read when the relay goes on, so the time of reading says nothing."""
    it, now = topic(), START
    assert it.passes("pad", moves=True, now=now)
    assert it.passes("pad", moves=False, now=now)
    assert not it.passes("planner", moves=True, now=now + 10)
    assert it.passes("planner", moves=True, now=settle(it, now + 10))


@pytest.mark.parametrize(("pause", "wait"), [(0.04, 0.0), (FREE - 0.1, 0.0), (FREE - 0.05, 0.03)])
def test_a_pause_in_the_free_time_delays_a_hand_back_only_if_it_ends_late(pause: float, wait: float) -> None:
    """Messages that came in a pause are read in `SETTLE` after it."""
    it, now = topic(), START
    assert it.passes("pad", moves=True, now=now)
    assert it.passes("pad", moves=False, now=now)
    let_go(it, now, since=pause)
    if wait:
        assert not it.passes("planner", moves=True, now=now + FREE + wait - 0.001)
    assert it.passes("planner", moves=True, now=now + FREE + wait + 0.001)


def test_silence_after_a_motion_keeps_lower_ranks_out() -> None:
    """However long it lasts, until the driver lets go or an operator hands the topic back."""
    it, now = topic(), START
    assert it.passes("web", moves=True, now=now)
    now += 1000
    assert not it.passes("planner", moves=True, now=now)
    assert it.driver == RankDriver("web", 1, "lost")
    assert it.passes("web", moves=False, now=now)
    let_go(it, now)
    assert it.passes("planner", moves=True, now=now + FREE)
    assert it.passes("web", moves=True, now=now + 1)
    it.free(now + 10)
    assert it.passes("planner", moves=True, now=settle(it, now + 10))


def test_a_lost_driver_is_replaced_by_its_own_rank() -> None:
    """A node that began again has another key; a second one of the rank does not take over from a live driver."""
    it, now = topic(), START
    assert it.passes("web", moves=True, now=now)
    assert not it.passes("tablet", moves=True, now=now)
    it.lose("web", now)
    assert it.passes("tablet", moves=True, now=now)
    assert not it.passes("web", moves=True, now=now)


@pytest.mark.parametrize("by_operator", [True, False])
def test_a_relay_that_knows_nothing_waits_for_the_highest_rank(by_operator: bool) -> None:
    """For as long as it takes; an operator may decide."""
    it, now = topic(_NEW), START
    assert not it.passes("planner", moves=True, now=now + 1000)
    assert not it.passes("web", moves=True, now=now + 1000)
    if by_operator:
        it.free(now + 1000)
    else:
        assert it.passes("pad", moves=True, now=now + 1000)
        assert it.passes("pad", moves=False, now=now + 1000)
    assert it.passes("planner", moves=True, now=settle(it, now + 1000 + FREE))


def test_a_relay_listens_before_lower_ranks_pass() -> None:
    """A motion in this time is noted, although it does not pass, and its node is the driver even if it falls silent."""
    it, now = topic(listens=True), START
    assert not it.passes("web", moves=True, now=settle(it, now))
    assert not it.passes("planner", moves=True, now=now + LISTEN_SECONDS)
    assert it.driver == RankDriver("web", 1, "moving")
    assert it.passes("web", moves=True, now=now + LISTEN_SECONDS)


def test_a_relay_listens_until_higher_ranks_are_connected() -> None:
    """But not for ever: a host that has ended keeps its registration for a while."""
    it = RankedTopic(_CALM, START, lambda _driver: None)
    for key in ("pad", "planner"):
        it.place(key, RANKS[key], FREE)
    it.opened("planner", START)
    settle(it, START)
    assert not it.passes("planner", moves=True, now=START + LISTEN_SECONDS)
    assert it.passes("planner", moves=True, now=START + LISTEN_MOST_SECONDS)


@dataclass(frozen=True, slots=True)
class Taken:
    """A message that the relay took."""

    at: float
    sent: float
    key: str
    moves: bool
    passed: bool

    @property
    def rank(self) -> int:
        return RANKS[self.key]


@dataclass
class Oracle:
    """Judges each message by the last motion that the base has heard."""

    heard: Taken | None = None  # the last motion
    last: Taken | None = None  # the last message that passed
    let_go: float | None = None  # when the driver's first zero after its last motion was taken
    given: float | None = None  # by an operator, after the last motion
    unknown: bool = True  # control and relay have forgotten who moved, and no rank 0 has moved since
    began: float = START  # the relay
    opened: dict[str, float] = field(default_factory=dict)
    closed: dict[str, float] = field(default_factory=dict)
    stalled: float = 0.0  # when the relay last went on after a pause
    noted: dict[str, float | None] = field(
        default_factory=dict
    )  # who moved while the relay listened, and let go then
    tried: set[str] = field(default_factory=set)  # who moved in this time at all
    passed: int = 0
    handed_over: int = 0

    def back(self) -> float | None:
        """Return when the topic was handed back, or None."""
        if self.given is not None:
            return self.given
        return None if self.let_go is None or self.unknown else self.let_go + FREE

    def judge(self, one: Taken) -> None:
        """Check one message after the other."""
        back, heard = self.back(), self.heard
        is_back = back is not None and one.at >= back - 1e-9
        if one.passed and not one.moves:
            its_own = self.last is not None and self.last.key == one.key
            assert its_own or one.key in self.tried, f"a zero of another one: {one}"
        elif one.passed:
            self._may_move(one, is_back=is_back, back=back)
        elif one.moves:
            settles = (
                self.given is not None and one.at < max(self.given, self.stalled) + SETTLE_SECONDS + STEP
            )
            assert one.rank > 0 or settles, f"rank 0 does not wait: {one}"
            calm = is_back and self._has_read_on(one.at - STEP)
            listened = one.at > self.began + LISTEN_MOST_SECONDS
            assert not (calm and listened) or self.tried, f"the topic is free since {back}: {one}"
        settled = is_back and self._has_read_on(one.at)
        if not (one.passed and one.moves) and one.at < self.began + LISTEN_MOST_SECONDS:
            higher = self.given is None and (heard is None or one.rank < heard.rank)
            self._note(
                one, may_begin=settled or higher
            )  # after an order, only what is certainly newer counts
        if one.passed and one.moves:
            self.noted.clear()
            self.tried.clear()
            self.handed_over += heard is None or heard.key != one.key
            self.heard, self.let_go, self.given, self.unknown = one, None, None, False
        elif one.passed and self.let_go is None:
            self.let_go = one.at
        if one.passed:
            self.last = one
            self.passed += 1

    def _has_read_on(self, at: float) -> bool:
        """Whether the relay must have read what was sent before the hand-back."""
        back = self.back()
        ready = back if self.given is None else self.given + SETTLE_SECONDS
        return ready is not None and at > max(ready, self.stalled + CHECK + SETTLE_SECONDS)

    def _note(self, one: Taken, *, may_begin: bool) -> None:
        first = all(key == one.key or RANKS[key] > one.rank for key in self.tried)
        self.tried |= {one.key} if one.moves else set()
        if one.moves and may_begin and first and not self.unknown and one.at >= self.began + SETTLE_SECONDS:
            self.noted = {one.key: None}
        elif not one.moves and self.noted.get(one.key, 0.0) is None:
            self.noted[one.key] = one.at

    def _may_move(self, one: Taken, *, is_back: bool, back: float | None) -> None:
        heard = self.heard
        if one.rank > 0 and one.at < self.began + LISTEN_MOST_SECONDS - 1e-9:
            higher = [key for key, rank in RANKS.items() if rank < one.rank]
            assert all(key in self.opened for key in higher), f"no higher rank can be heard: {one}"
            assert one.at >= self.began + LISTEN_SECONDS - 1e-9, f"the relay has not listened: {one}"
        for key, let_go in self.noted.items():
            done = let_go is not None and one.at >= let_go + FREE
            assert RANKS[key] >= one.rank or done, f"{key} moved while the relay listened: {one}"
        if self.unknown and not is_back:
            assert one.rank == 0, f"it is not known who moves: {one}"
            return
        if heard is None or one.key == heard.key or one.rank < heard.rank:
            return
        if not is_back:
            is_lost = one.at - heard.at >= LOST_SECONDS or self.closed.get(heard.key, 0) >= heard.at
            assert one.rank == heard.rank and is_lost, f"two are heard, {heard} and {one}"
        elif back is not None and (self.last is None or one.key != self.last.key):
            # the last one heard, if only by its zeros while the relay listened, may go on
            oldest = back - (0 if self.given is not None else SETTLE_SECONDS)
            assert one.sent >= oldest, f"it is older than the hand-back at {back}: {one}"


class Schedule:
    """Four publishers, a relay and a control, each of which may fail at any time."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)  # noqa: S311  a repeatable history
        self.now = START
        self.oracle = Oracle()
        self.known: RankDriver | None = None  # by control
        self.control = True
        self.queues: dict[str, list[tuple[float, float, bool]]] = {key: [] for key in RANKS}
        self.moving = dict.fromkeys(RANKS, False)
        self.due = dict.fromkeys(RANKS, START)
        self.period = {key: self.chance.choice((0.02, 0.05, 0.1)) for key in RANKS}
        self.rests = {key: self.chance.random() < 0.5 for key in RANKS}  # whether it sends zeros at rest
        self.connects: dict[str, float] = {}
        self.stalled_until = 0.0
        self.relay: RankedTopic | None = None
        self.relay_back = START
        self.control_back = START

    def report(self, driver: RankDriver) -> None:
        if self.control:
            self.known = driver

    def run(self, seconds: float) -> Oracle:
        for step in range(round(seconds / STEP)):
            self.now = START + step * STEP
            self._fail()
            for key in RANKS:
                self._live(key)
            if self.relay is not None and self.now >= self.stalled_until:
                self._turn(step)
        return self.oracle

    def _fail(self) -> None:
        chance, now = self.chance, self.now
        fate = chance.random()
        if self.relay is None and now >= self.relay_back:
            self._start()
        elif self.relay is not None and fate < 0.0006:
            self.relay, self.connects = None, {}
            self.relay_back = now + chance.uniform(0.1, 0.8)
            self.oracle.opened.clear()
            for queue in self.queues.values():
                queue.clear()
        elif self.relay is not None and fate < 0.0012:
            self.stalled_until = now + chance.uniform(0.05, 1.5)
        if self.control and 0.0012 <= fate < 0.0018:
            self.control, self.known, self.control_back = False, None, now + chance.uniform(0.05, 0.5)
        elif not self.control and now >= self.control_back and now >= self.stalled_until:
            self.control = True
            if self.relay is not None:
                self.known = self.relay.driver
        stuck = self.known is not None and self.known.standing in ("lost", "unknown")
        if (
            self.control
            and self.relay is not None
            and stuck
            and 0.1 < fate < 0.105
            and now >= self.stalled_until
        ):
            self.relay.free(now)
            self.oracle.given = now
            self.oracle.noted.clear()

    def _start(self) -> None:
        known = self.known if self.control else None
        place = _NEW if known is None else RankPlace(0, FREE, known.key, known.rank, known.standing)
        self.relay = RankedTopic(place, self.now, self.report)
        for key, rank in RANKS.items():
            self.relay.place(key, rank, FREE)
            self.connects[key] = self.now + self.chance.uniform(0, 1.2)
        self.oracle.began = self.now
        self.oracle.noted.clear()
        if place.standing == "unknown":
            self.oracle.unknown, self.oracle.given = True, None
        elif place.standing == "free":
            assert self.oracle.unknown or self.oracle.back() is not None, (
                "control believes that the topic is free"
            )
        elif self.oracle.heard is not None and place.driver == self.oracle.heard.key:
            self.oracle.let_go = None  # a zero in the last moments is forgotten: lower ranks wait longer

    def _live(self, key: str) -> None:
        chance, now = self.chance, self.now
        if self.moving[key] and chance.random() < (0.002 if key == "planner" else 0.02):
            self.moving[key] = False
            self.due[key] = now + chance.choice((0, 0, 0, 30.0))  # a zero, or a lost link
            self._send(key, moves=False)
        elif not self.moving[key] and chance.random() < (0.05 if key == "planner" else 0.003):
            self.moving[key], self.due[key] = True, now
        if now >= self.due[key]:
            self.due[key] = now + self.period[key]
            if self.moving[key] or self.rests[key]:
                self._send(key, moves=self.moving[key])

    def _send(self, key: str, *, moves: bool) -> None:
        if self.due[key] > self.now + 1 or self.relay is None or self.now < self.connects[key]:
            return
        queue = self.queues[key]
        arrives = max(self.now + self.chance.uniform(0, 0.03), queue[-1][0] if queue else 0.0)
        queue.append((arrives, self.now, moves))

    def _turn(self, step: int) -> None:
        relay, now = self.relay, self.now
        assert relay is not None
        if self.stalled_until > now - STEP:
            self.oracle.stalled = now
        for key in list(RANKS):
            if key not in self.oracle.opened and now >= self.connects[key]:
                relay.opened(key, now)
                self.oracle.opened[key] = now
        waiting = {key: queue for key, queue in self.queues.items() if queue and queue[0][0] <= now}
        while waiting:
            key = self.chance.choice(sorted(waiting))
            _arrived, sent, moves = waiting[key].pop(0)
            passed = relay.passes(key, moves=moves, now=now)
            self.oracle.judge(Taken(now, sent, key, moves, passed))
            if not waiting[key] or waiting[key][0][0] > now:
                del waiting[key]
        if relay.is_settling or not step % round(CHECK / STEP):
            relay.expire(now)


def test_schedules() -> None:
    """Never two are heard, rank 0 passes at once, nothing older than a hand-back, nothing after a loss."""
    run_schedules(range(60))


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_schedules_of_a_night() -> None:
    run_schedules(seeds_of_night(10_000))


def run_schedules(seeds: range) -> None:
    passed = handed_over = 0
    for seed in seeds:
        try:
            oracle = Schedule(seed).run(12.0)
        except AssertionError as error:
            error.add_note(f"in the schedule {seed}")
            raise
        passed, handed_over = passed + oracle.passed, handed_over + oracle.handed_over
    assert passed > 50 * len(seeds)
    assert handed_over > 2 * len(seeds)
