"""``pattern``: properties in near-English, after Dwyer's scopes and patterns, with HPL's meaning (Santos et al.).

A run is in a *mode*: the scope has not opened, is over, or is open and either *quiet* or *stirred*. A run is
stirred once the good event has come (``some``, ``requires``), while an answer is due (``causes``), or once
the first event has come (``forbids``). The mode and the time of one event are the whole state. Whether a mode
settles the verdict follows from the modes that are reachable from it.
"""

from dataclasses import dataclass
from typing import Any, Literal

from rosmop.logics.automaton import explore
from rosmop.logics.interface import (
    Categories,
    ClockedProperty,
    CompiledProperty,
    FiniteProperty,
    Move,
    Source,
    Wait,
)
from rosmop.logics.lexer import FormulaToken, TokenReader

VIOLATION: Categories = ("violation",)
VALIDATION: Categories = ("validation",)
UNDECIDED: Categories = ()

Mode = Literal["waiting", "quiet", "stirred", "over", "violated"]
MODES: tuple[Mode, ...] = ("waiting", "quiet", "stirred", "over", "violated")
_DUE: dict[str, Mode] = {"some": "quiet", "causes": "stirred"}
_DONE: dict[str, Mode] = {"some": "stirred", "causes": "quiet"}
ENFORCED: Categories = ("enforced",)


@dataclass(frozen=True)
class Pattern:
    """A pattern as written; events are indexes. ``no`` and ``some`` have no ``first``."""

    kind: str
    opens: int | None
    closes: int | None
    first: int | None
    second: int
    within_ns: int | None
    enforced: bool = False

    def initial(self) -> Mode:
        return "quiet" if self.opens is None else "waiting"

    def after_event(self, mode: Mode, event: int, *, late: bool) -> Mode:
        """Return the next mode. A ``late`` event comes more than ``within_ns`` after the start of the mode's clock."""
        if mode == "waiting":
            return "quiet" if event == self.opens else "waiting"
        if mode in ("over", "violated"):
            return mode
        if event == self.closes:
            return self._closed(mode)
        first, second = event == self.first, event == self.second
        violated = {
            "no": second and not late,
            "requires": first and (mode == "quiet" or late),
            "forbids": second and mode == "stirred" and not late,
        }
        if violated.get(self.kind, False):
            return "violated"
        if first if self.kind in ("causes", "forbids") else second and self.kind != "no":
            return "stirred"
        return "quiet" if second and self.kind == "causes" else mode

    def restarts_clock(self, before: Mode, event: int, mode: Mode) -> bool:
        """The clock runs from the opening of the scope, the oldest unanswered event, or the latest event."""
        if before == "waiting":
            return mode == "quiet"
        if mode != "stirred":
            return False
        if self.kind == "causes":
            return before == "quiet" or event == self.second
        return (self.kind == "requires" and event == self.second) or (
            self.kind == "forbids" and event == self.first
        )

    def _closed(self, mode: Mode) -> Mode:
        if mode == _DUE.get(self.kind):
            return "violated"
        return "over" if self.opens is None else "waiting"

    def after_deadline(self, mode: Mode) -> Mode:
        if self.within_ns is None:
            return mode
        if self.kind == "no" and mode == "quiet" and (self.opens is None or self.closes is None):
            return "over"
        if mode != _DUE.get(self.kind):
            return mode
        return _DONE[self.kind] if self.enforced else "violated"


def verdicts(pattern: Pattern, events: int) -> dict[Mode, Categories]:
    """Return the verdict of each mode, if it is certain.

    A due event can always come or be published later, unless it is the event that closes the scope.
    """
    unmet = {"violated", _DUE.get(pattern.kind, "violated")}
    found: dict[Mode, Categories] = {}
    for mode in MODES:
        possible = _reachable(pattern, mode, events)
        hopeless = pattern.closes == pattern.second and not pattern.enforced
        certain = mode == "violated" or (mode in unmet and hopeless)
        found[mode] = VIOLATION if certain else UNDECIDED if possible & unmet else VALIDATION
    return found


def _reachable(pattern: Pattern, mode: Mode, events: int) -> set[Mode]:
    lateness = (False,) if pattern.within_ns is None else (False, True)
    found: set[Mode] = set()
    waiting = [mode]
    while waiting:
        current = waiting.pop()
        if current in found:
            continue
        found.add(current)
        waiting.append(pattern.after_deadline(current))
        waiting += [
            pattern.after_event(current, event, late=late) for event in range(events) for late in lateness
        ]
    return found


class TimedPattern(ClockedProperty):
    """A pattern with a time bound, as tables; a state is the number of a mode.

    ``expiries[mode]`` is the mode after the deadline, or None without one. ``at_expiry`` are the categories at the
    deadline that come before the verdict.
    """

    def __init__(self, source: Source, pattern: Pattern, remedy: str | None) -> None:
        self.at_expiry = () if remedy is None else ENFORCED
        super().__init__(source, ("violation", "validation", *self.at_expiry))
        self.remedy = remedy
        self.pattern = pattern
        self.within = pattern.within_ns or 0
        self.initial = MODES.index(pattern.initial())
        known = verdicts(pattern, len(source.events))
        self.verdicts = tuple(known[mode] for mode in MODES)
        self.moves = self._moves(late=False)
        self.late = self._moves(late=True)
        self.expiries = tuple(
            MODES.index(after)
            if (after := pattern.after_deadline(mode)) != mode and not known[mode]
            else None
            for mode in MODES
        )
        self.waits = tuple(
            None
            if mode is None
            else Wait(self.within, (mode, False), (*self.at_expiry, *self.verdicts[mode]))
            for mode in self.expiries
        )

    def _moves(self, *, late: bool) -> tuple[tuple[Move, ...], ...]:
        table = []
        for mode in MODES:
            row = []
            for event in range(len(self.events)):
                after = self.pattern.after_event(mode, event, late=late)
                row.append((MODES.index(after), self.pattern.restarts_clock(mode, event, after)))
            table.append(tuple(row))
        return tuple(table)

    def refuse(self, run: Any) -> None:
        """Note that the message of the remedy did not come: what it would have settled is violated."""
        if self.verdicts[run.state] == VALIDATION:
            run.state = MODES.index("violated")

    def blocking_refused(self, category: str) -> str | None:
        super().blocking_refused(category)
        kind = self.pattern.kind
        comes_along = kind == "no" or self.pattern.enforced
        if kind in ("requires", "forbids") or (category == "violation" and comes_along):
            return None
        return f"`{kind} … within` is decided at a deadline, long after the message to drop was passed on"


def compile_pattern(source: Source) -> CompiledProperty:
    reader = TokenReader(source, (":", "(", ")"))
    opens, closes = _read_scope(reader)
    reader.expect(":", "`:` after the scope")
    kind, first, second = _read_body(reader)
    within = remedy = None
    if reader.token.text == "within":
        reader.take()
        within = reader.duration("a time bound")
    if reader.token.text == "enforced":
        remedy = _read_remedy(reader, kind, within)
    if reader.token.kind != "end":
        expected = "`within` and a duration" if within is None else "`enforced by` and a function"
        raise reader.unexpected(f"{expected}, or the end of the pattern")
    reader.finish()
    index = {name: number for number, name in enumerate(source.events)}
    known = [None if token is None else index[token.text] for token in (opens, closes, first)]
    pattern = Pattern(kind, known[0], known[1], known[2], index[second.text], within, remedy is not None)
    return TimedPattern(source, pattern, remedy) if within is not None else _untimed(source, pattern)


def _read_remedy(reader: TokenReader, kind: str, within: int | None) -> str:
    word = reader.take()
    if kind not in _DUE:
        reader.note(
            word,
            f"`{kind}` has no due message to publish: a message violates it; write `@violation {{ DROP; }}`",
        )
    elif within is None:
        reader.note(word, "`enforced by` needs a deadline; write `within` and a duration before it")
    if reader.token.text != "by":
        raise reader.unexpected("`by` and the function that publishes the due message")
    reader.take()
    return reader.expect("name", "the function that publishes the due message").text


def _untimed(source: Source, pattern: Pattern) -> FiniteProperty:
    known = verdicts(pattern, len(source.events))
    automaton = explore(
        pattern.initial(),
        len(source.events),
        lambda mode, event: pattern.after_event(mode, event, late=False),
        lambda mode: known[mode],
    )
    return FiniteProperty(source, ("violation", "validation"), automaton)


def _read_scope(reader: TokenReader) -> tuple[FormulaToken | None, FormulaToken | None]:
    word = reader.token
    if word.text not in ("globally", "after", "until"):
        raise reader.unexpected("a scope: `globally:`, `after a:`, `until b:` or `after a until b:`")
    reader.take()
    if word.text == "globally":
        return None, None
    event = _read_event(reader, f"the event that {'opens' if word.text == 'after' else 'closes'} the scope")
    if word.text == "until":
        return None, event
    if reader.token.text != "until":
        return event, None
    reader.take()
    return event, _read_event(reader, "the event that closes the scope")


def _read_body(reader: TokenReader) -> tuple[str, FormulaToken | None, FormulaToken]:
    word = reader.token
    if word.text in ("no", "some") and reader.ahead(1).text not in ("causes", "requires", "forbids"):
        reader.take()
        return word.text, None, _read_event(reader, f"an event after `{word.text}`")
    first = _read_event(reader, "`no`, `some` or an event")
    verb = reader.token
    if verb.text not in ("causes", "requires", "forbids"):
        raise reader.unexpected("`causes`, `requires` or `forbids`")
    reader.take()
    return verb.text, first, _read_event(reader, f"an event after `{verb.text}`")


def _read_event(reader: TokenReader, what: str) -> FormulaToken:
    token = reader.expect("name", what)
    reader.check_event(token)
    return token
