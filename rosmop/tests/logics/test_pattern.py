"""``pattern``: compared with a declarative meaning, where looking at all continuations decides certainty."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

from rosmop.logics.interface import CompiledProperty
from rosmop.tests.logics.driving import compiled, play

Timed = tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class Meaning:
    kind: str
    opens: str | None
    closes: str | None
    first: str
    second: str
    within: int | None

    def text(self) -> str:
        scope = {
            (False, False): "globally",
            (True, False): f"after {self.opens}",
            (False, True): f"until {self.closes}",
            (True, True): f"after {self.opens} until {self.closes}",
        }[self.opens is not None, self.closes is not None]
        body = (
            f"{self.kind} {self.second}"
            if self.kind in ("no", "some")
            else f"{self.first} {self.kind} {self.second}"
        )
        return f"{scope}: {body}" + ("" if self.within is None else f" within {self.within} ns")

    def scopes(self, trace: Timed) -> Iterator[tuple[int, Timed, bool]]:
        opened: int | None = 0 if self.opens is None else None
        inside: list[tuple[int, str]] = []
        for time, event in trace:
            if opened is None:
                if event == self.opens:
                    opened, inside = time, []
            elif event == self.closes:
                yield opened, tuple(inside), True
                opened = None
                if self.opens is None:
                    return
            else:
                inside.append((time, event))
        if opened is not None:
            yield opened, tuple(inside), False

    def unmet(self, trace: Timed, now: int) -> tuple[bool, frozenset[tuple[int, int]]]:
        results = [self._in_scope(*scope, now) for scope in self.scopes(trace)]
        due = {(number, place) for number, (_, places) in enumerate(results) for place in places}
        return any(violated for violated, _ in results), frozenset(due)

    def _in_scope(self, opened: int, inside: Timed, closed: bool, now: int) -> tuple[bool, set[int]]:
        def near(early: int, late: int) -> bool:
            return self.within is None or late - early <= self.within

        def missing(since: int, place: int) -> tuple[bool, set[int]]:
            over = closed or not near(since, now)
            return over, set() if over else {place}

        firsts = [(i, time) for i, (time, event) in enumerate(inside) if event == self.first]
        seconds = [(i, time) for i, (time, event) in enumerate(inside) if event == self.second]
        if self.kind == "no":
            return any(near(opened, time) for _, time in seconds), set()
        if self.kind == "some":
            return (False, set()) if any(near(opened, time) for _, time in seconds) else missing(opened, -1)
        if self.kind == "causes":
            unanswered = [
                missing(t, i) for i, t in firsts if not any(j > i and near(t, u) for j, u in seconds)
            ]
            return any(violated for violated, _ in unanswered), set().union(*(due for _, due in unanswered))
        if self.kind == "requires":
            return any(not any(j < i and near(u, t) for j, u in seconds) for i, t in firsts), set()
        return any(j > i and near(t, u) for i, t in firsts for j, u in seconds), set()

    def verdict(self, trace: Timed, now: int, events: tuple[str, ...], ahead: int) -> tuple[str, ...]:
        gaps = (0,) if self.within is None else (0, self.within + 1)
        _, due_now = self.unmet(trace, now)
        can_meet = can_miss = False
        for length in range(ahead + 1):
            for steps in product(product(gaps, events), repeat=length):
                time, longer = now, list(trace)
                for gap, event in steps:
                    time += gap
                    longer.append((time, event))
                for end in {time, time + gaps[-1]}:
                    violated, due = self.unmet(tuple(longer), end)
                    can_meet = can_meet or not (violated or due & due_now)
                    can_miss = can_miss or violated or bool(due)
                if can_meet and can_miss:
                    return ()
        return ("validation",) if can_meet else ("violation",)


def meanings(events: tuple[str, ...], bounds: tuple[int | None, ...]) -> list[Meaning]:
    scopes = [
        (None, None),
        *((e, None) for e in events),
        *((None, e) for e in events),
        *product(events, events),
    ]
    return [
        Meaning(kind, opens, closes, first, second, within)
        for kind in ("no", "some", "causes", "requires", "forbids")
        for opens, closes in scopes
        for first, second in product(events[:1] if kind in ("no", "some") else events, events)
        for within in bounds
    ]


def told_by(meaning: Meaning, trace: Timed, end: int) -> list[tuple[int, tuple[str, ...]]]:
    record = []
    decided = bool(meaning.verdict((), 0, ("a", "b", "c"), 3))
    seen: list[tuple[int, str]] = []
    for instant in range(end):
        for time, event in trace:
            if time == instant:
                seen.append((time, event))
                verdict = meaning.verdict(tuple(seen), instant, ("a", "b", "c"), 3)
                record.append((instant, verdict))
                decided = bool(verdict)
        if not decided and (passed := _deadline(meaning, tuple(seen), instant)):
            record.append((instant, passed))
            decided = True
    return record


def _deadline(meaning: Meaning, seen: Timed, instant: int) -> tuple[str, ...]:
    if meaning.unmet(seen, instant + 1)[0]:
        return ("violation",)
    windows = [opened + (meaning.within or 0) for opened, _, closed in meaning.scopes(seen) if not closed]
    if meaning.kind == "no" and instant in windows:
        return meaning.verdict(seen, instant + 1, ("a", "b", "c"), 3)
    return ()


def test_a_published_remedy_counts_as_the_answer() -> None:
    for scope, closes in (("globally", ""), ("after c", ""), ("until c", "c"), ("after c until b", "b")):
        for body in ("some a", "b causes a", "some b", "a causes b"):
            if body[-1] == closes:
                continue
            text = f"{scope}: {body} within 2 ns"
            enforced, plain = compiled("pattern", f"{text} enforced by f"), compiled("pattern", text)
            for times in ((0, 1, 3), (1, 2, 2), (2, 2, 5), (0, 4, 9)):
                for events in product("abc", repeat=3):
                    trace = list(zip(times, events, strict=True))
                    record = play(enforced.start(0), "abc", trace, 30)
                    remedies = [time for time, told in record if "enforced" in told]
                    check_remedies(plain, trace, remedies, body[-1])
                    told = [(time, tuple(one for one in told if one != "enforced")) for time, told in record]
                    answered = with_answers(trace, remedies, body[-1])
                    assert first(told) == first(play(plain.start(0), "abc", answered, 30)), (text, trace)


def with_answers(trace: list[tuple[int, str]], remedies: list[int], answer: str) -> list[tuple[int, str]]:
    return sorted([*trace, *((time, answer) for time in remedies)], key=lambda one: one[0])


def check_remedies(
    plain: CompiledProperty, trace: list[tuple[int, str]], remedies: list[int], answer: str
) -> None:
    for place, time in enumerate(remedies):
        before = [one for one in with_answers(trace, remedies[:place], answer) if one[0] <= time]
        assert play(plain.start(0), "abc", before, time + 1)[-1] == (time, ("violation",)), (trace, remedies)


def first(record: list[tuple[int, tuple[str, ...]]]) -> tuple[int, tuple[str, ...]] | None:
    return next((one for one in record if one[1]), None)
