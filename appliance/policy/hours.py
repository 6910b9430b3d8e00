"""Rights with a time: `laptop until 2026-12-05`, `operator during night`, and the section `[Hours]`. No clock.

A time without a zone is in the zone of `[Hours]`, or UTC, so a text means the same on each machine. Where a change of
the clocks makes a local time ambiguous or leaves it out, a right begins at the later and ends at the earlier time.
"""

import math
import re
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta, tzinfo
from typing import NamedTuple
from zoneinfo import ZoneInfo

from appliance.base.validation_messages import meant
from appliance.policy.host_sets import Atom
from appliance.policy.ini_reader import Entry, SectionText, Word, is_repeated
from appliance.policy.policy_findings import Findings, quote

UNTIL, DURING = "until", "during"
LIMITING = (UNTIL, DURING)
"""The words that limit the host before them in time."""
NEVER = -math.inf
_ZONE = "zone"
_DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,31}", re.ASCII)
_SPAN = re.compile(r"([01]\d|2[0-3]):([0-5]\d)-([01]\d|2[0-4]):([0-5]\d)", re.ASCII)
_DATE = re.compile(r"\d{4}-\d\d-\d\d(?:T([01]\d|2[0-3]):[0-5]\d(?::[0-5]\d)?)?", re.ASCII)
_ZONE_NAME = re.compile(r"[A-Za-z][\w+-]*+(?:/[A-Za-z][\w+-]*+){0,2}", re.ASCII)
_WHOLE_DAY = 24 * 60
_LINES = 64
_SPANS = 16  # of a line
_SHOWN = 40


class Span(NamedTuple):
    """Minutes of local days: from `begin`, to `end` of the same day, or of the next one if that is not later."""

    days: frozenset[int]
    begin: int
    end: int


class HoursNow(NamedTuple):
    """The end of the span that contains a time (`NEVER`: none does), and the next begin."""

    end: float
    begin: float | None


@dataclass(frozen=True, slots=True)
class Hours:
    """A line of `[Hours]`, such as `night = 22:00-06:00` or `shift = mon-fri 06:00-14:00, sat 08:00-12:00`."""

    text: str
    spans: tuple[Span, ...]
    zone: tzinfo

    def at(self, now: float) -> HoursNow:
        today, zone = datetime.fromtimestamp(now, self.zone).date(), self.zone
        some = []
        for number in range(-1, 9):  # each span begins within a week
            day = today + timedelta(days=number)
            for span in (one for one in self.spans if day.weekday() in one.days):
                end = span.end + _WHOLE_DAY * (span.end <= span.begin)
                some.append((max(_instants(day, span.begin, zone)), min(_instants(day, end, zone))))
        last, begins = NEVER, []
        for one in sorted(some):
            if one[0] <= max(now, last):  # spans without a time between them are one
                last = max(last, one[1]) if one[1] > now else last
            else:
                begins.append(one[0])
        return HoursNow(last, min(begins, default=None))


_ALWAYS = HoursNow(math.inf, None)


@dataclass(frozen=True, slots=True)
class RightTime:
    """The time of a host in a line, in seconds since the epoch. `text` is the host with its time, as written."""

    text: str
    limit: str
    line: int
    until: float
    hours: Hours | None

    def changes(self, hours: HoursNow) -> set[float]:
        """Return the next begin, and the ends by which `closed_at` decides. A passed end by date stays."""
        begins = {hours.begin} if hours.begin is not None and hours.begin < self.until else set()
        return {one for one in (self.until, hours.end, *begins) if abs(one) < math.inf}

    def closed_at(self, now: float, passed: Mapping[float, bool], hours: HoursNow) -> "ClosedTime | None":
        if passed.get(self.until, now >= self.until):
            return ClosedTime(f"{self.limit} has ended", for_good=True)
        is_closed = passed.get(hours.end, hours.end == NEVER)
        return ClosedTime(f"{self.limit} is not now") if is_closed else None


class ClosedTime(NamedTuple):
    """Why a right with a time grants nothing now, as the end of a sentence. `for_good`: its date has passed."""

    why: str
    for_good: bool = False


Times = Mapping[Atom, RightTime]
ClosedTimes = Mapping[Atom, ClosedTime]


def closed_times(times: Times, now: float | None, passed: Mapping[float, bool]) -> ClosedTimes:
    """Return the times that do not contain `now`, which is None while the time is not known.

    `passed` says of some ends whether they have passed, by a clock that is better for it than `now`.
    """
    if now is None:
        return {atom: ClosedTime(f"{one.limit} waits until the clock is set") for atom, one in times.items()}
    hours = _hours_at(times, now)
    found = ((atom, one.closed_at(now, passed, hours[one.hours])) for atom, one in times.items())
    return {atom: closed for atom, closed in found if closed is not None}


def changes_of(times: Times, now: float) -> set[float]:
    hours = _hours_at(times, now)
    return {change for moment in times.values() for change in moment.changes(hours[moment.hours])}


def _hours_at(times: Times, now: float) -> dict[Hours | None, HoursNow]:
    some = {moment.hours for moment in times.values()}
    return {hours: _ALWAYS if hours is None else hours.at(now) for hours in some}


def instant(text: str, zone: tzinfo) -> float:
    """Return a local time such as `2026-12-05T18:00` in seconds since the epoch; a date is its end.

    Raises `ValueError`.
    """
    form = _DATE.fullmatch(text)
    try:
        given = datetime.fromisoformat(text) if form else None
    except ValueError:
        given = None
    if given is None or form is None or not 2000 <= given.year < 3000:
        raise ValueError(f"{quote(text)} is not a date: write 2026-12-05, or 2026-12-05T18:00")
    minutes = given.hour * 60 + given.minute if form[1] else _WHOLE_DAY
    return min(_instants(given.date(), minutes, zone)) + given.second


def host_units(words: Sequence[Word], groups: Iterable[str] = ()) -> list[tuple[Word, ...]]:
    """Return each host with the words that limit its time. A group with the name of such a word is a host."""
    limiting = set(LIMITING).difference(groups)
    units: list[tuple[Word, ...]] = []
    for word in words:
        if units and (word.text in limiting or units[-1][-1].text in limiting):
            units[-1] = (*units[-1], word)
        else:
            units.append((word,))
    return units


class HoursTable:
    """The lines of `[Hours]`, and the times of hosts that refer to them; mistakes are added to the findings."""

    def __init__(
        self, section: SectionText | None, groups: Collection[str], findings: Findings, now: float | None
    ) -> None:
        """`now` is for warnings, or None."""
        self._findings = findings
        self._now = now
        self._hours: dict[str, Hours] = {}
        self._unused: dict[str, Word] = {}
        self.zone: tzinfo = UTC
        entries = section.entries if section is not None else []
        if len(entries) > _LINES:
            findings.error(entries[_LINES].key, f"more than {_LINES} hours")
            entries = entries[:_LINES]
        for entry in entries:
            if entry.key.text == _ZONE:
                self.zone = self._read_zone(entry)
        lines: dict[Hashable, int] = {}
        for entry in entries:
            word = entry.key
            if is_repeated(word.text, word, lines, findings) or word.text == _ZONE:
                continue
            if not _NAME.fullmatch(word.text) or word.text in groups:
                why = (
                    "a group has this name"
                    if word.text in groups
                    else "at most 32 letters, digits and _ . -, a letter first"
                )
                findings.error(word, f"{quote(word.text)} is not a name of hours: {why}")
            self._unused[word.text] = word
            spans = tuple(self._spans(entry))
            if len(spans) > _SPANS:
                findings.error(word, f"more than {_SPANS} times in a line")
            text = " ".join(value.text for value in entry.values)
            shown = text if len(text) <= _SHOWN else f"{text[: _SHOWN - 1]}…"
            self._hours[word.text] = Hours(f"{word.text} ({shown} {self.zone})", spans, self.zone)

    def warn_unused(self) -> None:
        for name, word in self._unused.items():
            self._findings.warn(word, f"the hours {quote(name)} are not used")

    def time_of(self, unit: tuple[Word, ...]) -> RightTime | None:
        """Return the time of a host; None if it has none, or a mistake."""
        if len(unit) > 1 and unit[0].text in LIMITING:
            self._findings.error(unit[0], f"name the host before {unit[0].text}")
            return None
        words: dict[str, Word] = {}
        for place in range(1, len(unit), 2):
            word = unit[place]
            if place + 1 == len(unit):
                example = "a date such as 2026-12-05" if word.text == UNTIL else "a name of [Hours]"
                self._findings.error(word, f"{word.text} needs {example} after it")
                return None
            if word.text in words:
                self._findings.error(word, f"{word.text} is already given for {unit[0].text}")
                return None
            words[word.text] = unit[place + 1]
        until = self._until(words[UNTIL]) if UNTIL in words else None
        hours = self._named(words[DURING]) if DURING in words else None
        if not words or (UNTIL in words and until is None) or (DURING in words and hours is None):
            return None
        text = " ".join(word.text for word in unit)
        about = [] if hours is None else [f"{DURING} {hours.text}"]
        limit = " ".join([*about, f"{UNTIL} {words[UNTIL].text}"] if UNTIL in words else about)
        if until is not None and self._now is not None and until <= self._now:
            self._findings.warn(unit[0], f"{text} has ended: it grants nothing, remove it")
        return RightTime(text, limit, unit[0].line, math.inf if until is None else until, hours)

    def _named(self, word: Word) -> Hours | None:
        self._unused.pop(word.text, None)
        hours = self._hours.get(word.text)
        if hours is None:
            add = meant(word.text, self._hours) or f": add a line such as {word.text} = 22:00-06:00"
            self._findings.error(word, f"[Hours] has no {quote(word.text)}{add}")
        return hours

    def _until(self, word: Word) -> float | None:
        try:
            return instant(word.text, self.zone)
        except ValueError as fault:
            self._findings.error(word, str(fault))
            return None

    def _read_zone(self, entry: Entry) -> tzinfo:
        text = " ".join(word.text for word in entry.values)
        try:
            if text == "UTC":
                return UTC
            if _ZONE_NAME.fullmatch(text):
                return ZoneInfo(text)
        except (KeyError, ValueError, OSError):
            pass
        hint = "write a name such as Europe/Berlin or UTC; this machine's list is the package tzdata"
        self._findings.error(entry.key, f"{quote(text)} is not a zone of this machine: {hint}")
        return UTC

    def _spans(self, entry: Entry) -> Iterable[Span]:
        days, some = frozenset(range(7)), False
        for word in entry.values:
            span = _SPAN.fullmatch(word.text)
            if span is None:
                days = self._days(word)
                some = not days  # one error for a mistake
                continue
            first, second, third, fourth = map(int, span.groups())
            begin, end, some = first * 60 + second, third * 60 + fourth, True
            if begin == end or end > _WHOLE_DAY:
                self._findings.error(
                    word, f"{quote(word.text)} is not a time of a day: a whole day is 00:00-24:00"
                )
            yield Span(days, begin, end)
        if not some:
            self._findings.error(entry.key, f"give the time, such as {entry.key.text} = mon-fri 06:00-14:00")

    def _days(self, word: Word) -> frozenset[int]:
        first, dash, last = word.text.casefold().partition("-")
        last = last if dash else first
        if first in _DAYS and last in _DAYS:
            begin, end = _DAYS.index(first), _DAYS.index(last)
            return frozenset((begin + number) % 7 for number in range((end - begin) % 7 + 1))
        text = "write days and times such as mon-fri 06:00-14:00 sat 08:00-12:00"
        self._findings.error(word, f"{quote(word.text)} is neither days nor a time: {text}")
        return frozenset()


def _instants(day: date, minutes: int, zone: tzinfo) -> tuple[float, float]:
    """Return the two instants that a local time may mean; most times mean one."""
    moment = datetime.combine(day + timedelta(days=minutes // _WHOLE_DAY), time(0), zone)
    moment = moment.replace(hour=minutes % _WHOLE_DAY // 60, minute=minutes % 60)
    return moment.timestamp(), moment.replace(fold=1).timestamp()
