"""Propose conditions on a topic's messages and on their order, each with a bound that the recordings support.

All bounds of the file together are expected to be exceeded once in `QUIET_HOURS` (`extremes`). Conditions that
exclude nothing, such as a rate that allows any change, are left out.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from decimal import ROUND_CEILING, Decimal

from rosmop.learn.series import HighestValues, Series, Statistic, ValueSeries
from rosmop.learn.topic_orders import TopicOrders, TopicPair
from rosmop.learn.topics import TopicContent, TopicRhythm
from rosmop.text.complaints import FORBIDDEN, RESERVED
from rosmop.text.parser import MAX_CHARACTERS
from roswire.counted import counted

# Write numbers, strings, names and conditions of `.rv` text.

_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r"}
_PRINTABLE = re.compile(r"[ -~]*+\Z")
CPP = {
    "float32": "float", "float64": "double", "byte": "int8_t", "char": "uint8_t", "string": "std::string",
    "bool": "bool", **{f"{sign}int{size}": f"{sign}int{size}_t" for sign in ("", "u") for size in (8, 16, 32, 64)},
}  # fmt: skip
WORDS = frozenset(FORBIDDEN) | RESERVED


def rounded_up(value: float, width: float) -> str:
    if not width > 0:
        return number(value)
    quantum = Decimal(1).scaleb(math.floor(math.log10(max(width / 100, 5e-324))))
    return number(float(Decimal(value).quantize(quantum, ROUND_CEILING)))


def rounded_down(value: float, width: float) -> str:
    return number(-float(rounded_up(-value, width)))


def number(value: float) -> str:
    text = repr(value)
    if isinstance(value, int) and value >= 1 << 63:
        return f"{text}u"  # only an unsigned type holds it
    return "0.0" if text == "-0.0" else text


def literal(value: object) -> str | None:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{quote(value)}"' if _PRINTABLE.match(value) else None
    return number(value) if isinstance(value, int | float) and math.isfinite(value) else None


def quote(text: str) -> str:
    return "".join(_ESCAPES.get(letter, letter) for letter in text)


def one_line(text: str) -> str:
    """Replace line ends by spaces, and escape other control characters."""
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in words)


def escape(text: str) -> str:
    return quote(text).replace("%", "%%")


def identifier(text: str) -> str:
    name = re.sub(r"[^A-Za-z0-9]++", "_", text).strip("_") or "root"
    return f"n{name}" if name[0].isdigit() else name


def short_names(paths: Iterable[str]) -> dict[str, str]:
    paths = list(paths)
    names: dict[str, str] = {}
    for path in paths:
        steps = path.split(".")
        for count in range(1, len(steps) + 1):
            end = ".".join(steps[-count:])
            others = (other for other in paths if other != path)
            if count == len(steps) or not any(other == end or other.endswith("." + end) for other in others):
                name = "_".join(steps[-count:])
                name = f"n{name}" if name[0].isdigit() else name
                taken = name in WORDS or name in names.values() or name in _OWN
                names[path] = f"{name}_field" if taken else name
                break
    return names


_OWN = frozenset({
    "now", "elapsed", "before", "begun", "i", "messages", "opened", "message", "stamped", "abs", "isinf",
    "MESSAGE", "vector", "numeric_limits", "true", "false",
})  # fmt: skip


# Set a bound beyond the observed values, by extreme value theory on the extremes of independent windows.
#
# Gumbel's distribution, which suits exponential tails, is fitted to the largest value of each window by
# L-moments (Hosking 1990). The bound is the level that is passed once in a given number of windows. No shape
# parameter is fitted, because some twenty windows are too few: if the quantity has a limit, the margin is wider
# than needed, which causes no false alarm.
#
# If a robot sometimes goes far, the upper quarter of windows has a longer tail: the exponential through its
# mean excess (Weissman 1978) is the bound if it is higher. An extreme that several windows reach exactly is a
# stop, such as a joint's limit, and is then the bound.

FEWEST_WINDOWS = 8

_STOP = 3  # the minimum number of windows that reach the same extreme
_SAME = 1e-9  # relative difference that rounding can cause between equal extremes
_TAIL = 4  # the tail is the highest of this many equal parts of the values
_EULER = 0.5772156649015329


def upper(highs: Iterable[float], windows: float, *, stops: bool = False) -> float | None:
    """Return the level that the maximum of a window exceeds once in `windows` windows, or None with too little data.

    With `stops`, the quantity may have a stop. Calculated quantities have none, because rounded differences
    can be equal by chance.
    """
    values = sorted(highs)
    count = len(values)
    if count < FEWEST_WINDOWS:
        return None
    top = values[-1]
    if stops and top - values[-_STOP] <= _SAME * abs(top):
        return top
    first = sum(values) / count
    second = sum(index * value for index, value in enumerate(values)) / (count * (count - 1))
    scale = (2 * second - first) / math.log(2)
    place = first - _EULER * scale
    level = place - scale * math.log(-math.log1p(-1 / max(windows, 2.0)))
    highest = count // _TAIL
    threshold = values[-highest - 1]
    excess = sum(values[-highest:]) / highest - threshold
    return max(level, threshold + excess * math.log(max(windows * highest / count, 1.0)), top)


QUIET_HOURS = 10.0
MAX = {"range": 10, "constant": 12, "values": 6, "rate": 6, "unchanged": 6, "moves": 2, "order": 2}
"""The most conditions of a kind for one topic. Other kinds have at most one for each field."""

_LONGEST = MAX_CHARACTERS // 4
"""The most characters of one topic's conditions, which are in one file even if some are widened."""

_FEWEST = 20  # the minimum number of messages for a statement about all messages
_FEWEST_SET = 10
_ALWAYS_CHANGING = 0.5  # the fraction of messages with a changed value
_REGULAR = 8.0  # usual gaps; a topic with a longer pause is not regular


@dataclass(frozen=True)
class CandidateSupport:
    messages: int
    seconds: float
    recordings: int


@dataclass(frozen=True)
class Candidate:
    """One condition that held in all recordings.

    `says` begins the warning, and is unique. In `condition`, `{v}` stands for the field's value, `{n}` for a name
    made of the field's path, and `{t}` for a prefix of the topic's own. `condition` needs the declarations `state`,
    and the statements `first` before and `then` after all conditions. A candidate may have a `formula` instead.
    """

    topic: str
    kind: str
    path: str
    says: str
    seen: str
    support: CandidateSupport
    element: int | None = None
    folded: bool = False
    length: int | None = None
    condition: str = ""
    shown: str = ""
    state: tuple[str, ...] = ()
    first: tuple[str, ...] = ()
    then: tuple[str, ...] = ()
    formula: str = ""
    events: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    alarms: int = 0
    widened: str = ""

    @property
    def key(self) -> tuple[str, str, str, int | None]:
        return self.topic, self.kind, self.path, self.element

    @property
    def size(self) -> int:
        """About the number of characters in the text."""
        names = self.condition.count("{v}") + 12
        return 300 + len(self.condition) + len(self.seen) + names * len(self.path)

    @property
    def topics(self) -> set[str]:
        return {topic for topic, _ in self.events.values()} | {self.topic}

    @property
    def place(self) -> str:
        return self.path if self.element is None else f"{self.path}[{self.element}]"


@dataclass
class LearntFacts:
    """The observations of all topics."""

    types: Mapping[str, str]
    fields: Mapping[str, Mapping[str, str]]
    rhythms: Mapping[str, TopicRhythm]
    contents: Mapping[str, TopicContent]
    orders: TopicOrders
    seconds: float
    windows: int
    trimmed: Counter[str] = field(default_factory=Counter)

    @property
    def short(self) -> Mapping[str, str]:
        paths = {topic: identifier(topic).replace("_", ".") for topic in self.contents}
        names = short_names(paths.values())
        return {topic: names[path] for topic, path in paths.items()}

    def candidates(self) -> Iterator[Candidate]:
        bounds = sum(3 * len(self.fields[topic]) for topic in self.contents) + len(self.orders.pairs)
        mean = max(self.seconds / self.windows, 1e-3)
        proposer = _Proposer(self, QUIET_HOURS * 3600 / mean * max(bounds, 1))
        self.trimmed.clear()
        for topic in sorted(self.contents):
            found: Counter[str] = Counter()
            room = _LONGEST
            for candidate in proposer.of_topic(topic):
                found[candidate.kind] += 1
                most = MAX.get(candidate.kind, len(self.fields[topic]))
                if found[candidate.kind] <= most and candidate.size <= room:
                    room -= candidate.size
                    yield candidate
                else:
                    self.trimmed[topic] += 1
        yield from proposer.of_orders()


_WHOLE_NUMBERS = (-(1 << 63), (1 << 63) - 1), (-(1 << 63), (1 << 64) - 1)

# Path, element and length of an array, and the statistics of its values
_Place = tuple[str, int | None, int | None, Series]


class _Proposer:
    def __init__(self, known: LearntFacts, windows: float) -> None:
        self._known = known
        self._windows = windows

    def of_topic(self, topic: str) -> Iterator[Candidate]:
        rhythm, content = self._known.rhythms[topic], self._known.contents[topic]
        support = self._support(rhythm)
        yield from self._rhythm(topic, rhythm, content, support)
        if rhythm.count < _FEWEST_SET:
            return
        yield from self._stamps(topic, content, support)
        for path, lengths in self._by_field(topic, content.lengths):
            if len(lengths.windows) == 1:
                (length,) = lengths.windows
                always = f"always {counted(length, 'element')}"
                yield Candidate(
                    topic, "length", path, f"{path} has another length", always, support,
                    condition=f"{{v}}.size() != {length}", shown="(long) {v}.size()",
                )  # fmt: skip
        yield from self._sets(topic, content, support)
        if rhythm.count < _FEWEST:
            return
        for place in sorted(self._numbers(topic, content), key=lambda found: -found[3].changed):
            yield from self._number(topic, rhythm, place)

    def _by_field(self, topic: str, rows: Mapping[str, Statistic]) -> Iterator[tuple[str, Statistic]]:
        return ((path, rows[path]) for path in self._known.fields[topic] if path in rows)

    def _support(self, rhythm: TopicRhythm) -> CandidateSupport:
        return CandidateSupport(rhythm.count, round(self._known.seconds, 1), len(rhythm.recordings))

    def _upper(self, highs: HighestValues, *, stops: bool = False) -> float | None:
        return upper(highs.of.values(), self._windows, stops=stops)

    def _rhythm(
        self, topic: str, rhythm: TopicRhythm, content: TopicContent, support: CandidateSupport
    ) -> Iterator[Candidate]:
        most = self._upper(content.counts)
        if most is not None and rhythm.count >= _FEWEST:
            span, limit = rhythm.interval, math.ceil(most)
            yield Candidate(
                topic, "often", "", "comes too often", f"at most {content.counts.top:g} in {span:g} s", support,
                condition=f"{{t}}messages > {limit}", shown="(long) {t}messages",
                state=("double {t}opened = 0.0;", "int {t}messages = 0;"),
                first=(
                    f"if (now - {{t}}opened >= {number(span)}) {{ {{t}}opened = now; {{t}}messages = 0; }}",
                    "{t}messages = {t}messages + 1;",
                ),
            )  # fmt: skip
        longest = self._upper(rhythm.gaps)
        if longest is None or rhythm.count < _FEWEST or longest > _REGULAR * rhythm.period:
            return
        # A message that is less than half a period late is not missing.
        milliseconds = math.ceil(max(longest, 1.5 * rhythm.period) * 1000)
        yield Candidate(
            topic, "late", "", f"is silent for {milliseconds} ms",
            f"every {rhythm.period * 1000:.1f} ms, at most {rhythm.gaps.top * 1000:.1f} ms apart", support,
            formula=f"pattern: globally: message causes message within {milliseconds}ms",
        )  # fmt: skip

    def _stamps(self, topic: str, content: TopicContent, support: CandidateSupport) -> Iterator[Candidate]:
        age, lead = self._upper(content.ages), self._upper(content.leads)
        if not content.ages.of:
            return
        if not content.backward:
            yield Candidate(
                topic, "stamp", "header.stamp", "header.stamp goes backward", "never backward", support,
                condition="{v}.toSec() < {t}stamped", shown="{t}stamped - {v}.toSec()",
                state=("double {t}stamped = 0.0;",), then=("{t}stamped = {v}.toSec();",),
            )  # fmt: skip
        if age is not None and lead is not None:
            width = max(content.ages.top + content.leads.top, 1e-4)  # 0.1 ms is not a delay
            low, high = rounded_down(-lead - 1e-4, width), rounded_up(age + 1e-4, width)
            yield Candidate(
                topic, "age", "header.stamp", "header.stamp is too old or too new",
                f"{-content.leads.top * 1000:.2f} to {content.ages.top * 1000:.2f} ms before the reception", support,
                condition=f"now - {{v}}.toSec() < {low} || now - {{v}}.toSec() > {high}",
                shown="now - {v}.toSec()",
            )  # fmt: skip

    def _sets(self, topic: str, content: TopicContent, support: CandidateSupport) -> Iterator[Candidate]:
        types = self._known.fields[topic]
        for path, values in self._by_field(topic, content.sets):
            if types[path] != "string[]":
                yield from self._set(topic, content, path, values, support)
            elif len(values.windows) == 1 and values.closed:
                (texts,) = values.windows
                pieces = [literal(text) for text in texts]
                if texts and None not in pieces:
                    unlike = " || ".join(f"{{v}}[{place}] != {text}" for place, text in enumerate(pieces))
                    yield Candidate(
                        topic, "constant", path, f"{path} is another", f"always {', '.join(map(str, pieces))}", support,
                        condition=unlike, length=len(texts),
                    )  # fmt: skip
        integers = {
            path: series
            for path, series in self._by_field(topic, content.numbers)
            if not types[path].startswith("float")
        }  # fmt: skip
        for path, series in integers.items():
            if not types[path].endswith("]"):
                yield from self._set(topic, content, path, series.values, support)

    def _set(
        self, topic: str, content: TopicContent, path: str, values: ValueSeries, support: CandidateSupport
    ) -> Iterator[Candidate]:
        texts = [literal(value) for value in values.sorted_values]
        if not values.closed or None in texts:
            return
        if self._known.fields[topic][path] == "bool" and len(texts) == 2:  # `bool` has no other values
            yield from self._moves(topic, content, path, values, support)
            return
        shown = "{v}.c_str()" if self._known.fields[topic][path] == "string" else "(long) {v}"
        yield Candidate(
            topic, "constant" if len(texts) == 1 else "values", path, f"{path} has a new value",
            f"always {texts[0]}" if len(texts) == 1 else f"one of {', '.join(map(str, texts))}", support,
            condition=" && ".join(f"{{v}} != {text}" for text in texts), shown=shown,
        )  # fmt: skip
        yield from self._moves(topic, content, path, values, support)

    def _moves(
        self, topic: str, content: TopicContent, path: str, values: ValueSeries, support: CandidateSupport
    ) -> Iterator[Candidate]:
        moves = content.moves.get(path, {})
        ordered = values.sorted_values
        count = len(ordered)
        if count < 3 or len(moves) >= count * (count - 1) or min(moves.values(), default=0) < 3:
            return
        names = {value: f"value{place}" for place, value in enumerate(ordered)}
        go = {value: f"{name} -> at_{name}" for value, name in names.items()}
        states = " ".join(
            f"at_{names[value]} [ {', '.join(go[to] for to in ordered if to == value or (value, to) in moves)} ]"
            for value in ordered
        )
        begin = ", ".join(go.values())
        listed = "; ".join(
            f"{literal(a)} to {literal(b)}"
            for a, b in sorted(moves, key=lambda move: (ordered.index(move[0]), ordered.index(move[1])))
        )
        yield Candidate(
            topic, "moves", path, f"{path} makes a move that was never seen", listed, support,
            formula=f"fsm: start [ {begin} ] {states}",
            events={names[value]: (topic, f"{path}:{literal(value)}") for value in ordered},
        )  # fmt: skip

    def _numbers(self, topic: str, content: TopicContent) -> Iterator[_Place]:
        for path, series in self._by_field(topic, content.numbers):
            row = content.elements.get(path)
            if row:
                yield from ((path, place, len(row), element) for place, element in enumerate(row))
            elif (
                self._known.fields[topic][path].endswith("]")
                or self._known.fields[topic][path].startswith("float")
                or series.values.many
            ):
                yield path, None, None, series

    def _number(self, topic: str, rhythm: TopicRhythm, place_of: _Place) -> Iterator[Candidate]:
        path, element, length, series = place_of
        support = self._support(rhythm)
        integer = not self._known.fields[topic][path].startswith("float")
        folded = self._known.fields[topic][path].endswith("]") and element is None
        place = path if element is None else f"{path}[{element}]"
        shown = "(long) {v}" if integer else "{v}"
        base = Candidate(
            topic, "", path, "", "", support, element=element, folded=folded, length=length, shown=shown
        )
        if not series.highs.of:
            return
        low, high = -series.lows.top, series.highs.top
        # The largest numbers of 64 bits are rounded up: they are floats here.
        least, most = _WHOLE_NUMBERS[self._known.fields[topic][path].startswith("u")]
        if low == high:
            only = literal(max(min(int(low), most), least) if integer else low)
            same = f"{{v}} != {only}" if not series.nan else f"{{v}} < {only} || {{v}} > {only}"
            yield replace(
                base, kind="constant", says=f"{place} has a new value", seen=f"always {only}",
                condition=same + (" && !isinf({v})" if series.infinite else ""),
            )  # fmt: skip
            return
        top, bottom = (self._upper(side, stops=True) for side in (series.highs, series.lows))
        if top is None or bottom is None:
            return
        width = high - low
        if not all(math.isfinite(2 * one) for one in (top, bottom, width)):
            return  # a bound would be beyond the largest number
        if integer:
            above, below = number(min(math.ceil(top), most)), number(max(-math.ceil(bottom), least))
        else:
            above, below = rounded_up(top, width), rounded_down(-bottom, width)
        within = f"{{v}} >= {below} && {{v}} <= {above}"
        outside = f"({{v}} < {below} || {{v}} > {above})" if series.nan else f"!({within})"
        also = [word for word, seen in (("NaN", series.nan), ("infinite", series.infinite)) if seen]
        yield replace(
            base, kind="range", says=f"{place} is out of range",
            seen=f"{low:.6g} to {high:.6g}" + (f", also {' and '.join(also)}" if also else ""),
            condition=outside + (" && !isinf({v})" if series.infinite else ""),
        )  # fmt: skip
        if folded:
            return
        rate = self._upper(series.rates)
        usual = max(rhythm.period, 1e-3)
        if rate is not None and rate * usual < width / 2:
            yield replace(
                base, kind="rate", says=f"{place} jumps", seen=f"at most {series.rates.top:.4g} a second",
                condition="{t}begun && std::abs({v} - {t}last_{n}) > "
                f"{rounded_up(rate, series.rates.top)} * elapsed",
                state=("double {t}last_{n} = 0.0;",), then=("{t}last_{n} = {v};",),
            )  # fmt: skip
        stays = self._upper(series.stays)
        mean = support.seconds / max(support.recordings, 1)
        if stays is not None and series.changed >= _ALWAYS_CHANGING * series.count and stays < mean / 3:
            limit = max(stays, 3 * usual)
            yield replace(
                base, kind="unchanged", says=f"{place} is stuck",
                seen=f"never the same for more than {series.stays.top:.3g} s",
                condition=f"now - {{t}}since_{{n}} > {rounded_up(limit, limit)}",
                state=("double {t}last_{n} = 0.0;", "double {t}since_{n} = 0.0;"),
                first=("if (!{t}begun || {v} != {t}last_{n}) { {t}since_{n} = now; }",), then=("{t}last_{n} = {v};",),
            )  # fmt: skip

    def of_orders(self) -> Iterator[Candidate]:
        orders = self._known.orders
        found: list[tuple[float, Candidate]] = []
        done: set[frozenset[str]] = set()
        for (a, b), pair in orders.pairs.items():
            if pair.turns and orders.pairs[b, a].turns and frozenset((a, b)) not in done:
                if not pair.requires:
                    continue  # reported for (b, a), because b begins
                done.add(frozenset((a, b)))
                formula = "fsm: first [ a -> second ] second [ b -> first ]"
                found.append((0.0, self._order((a, b), "turns", formula, "one after the other, always")))
        for (a, b), pair in orders.pairs.items():
            taking_turns = frozenset((a, b)) in done
            found += [
                row for row in self._timed(a, b, pair, orders) if row[1].kind == "causes" or not taking_turns
            ]
        counts: dict[str, int] = {}
        for _, candidate in sorted(found, key=lambda ranked: ranked[0]):
            names = [topic for topic, _ in candidate.events.values()]
            if all(counts.get(name, 0) < MAX["order"] for name in names):
                counts.update({name: counts.get(name, 0) + 1 for name in names})
                yield candidate

    def _timed(
        self, a: str, b: str, pair: TopicPair, orders: TopicOrders
    ) -> Iterator[tuple[float, Candidate]]:
        rhythms = self._known.rhythms
        seconds = max(self._known.seconds, 1e-3)
        back = self._upper(pair.back)
        if pair.requires and back is not None:
            rate, count = rhythms[a].count / seconds, rhythms[b].count
            if not orders.by_chance(back, rate, count):
                formula = f"pattern: globally: b requires a within {max(math.ceil(back * 1000), 1)}ms"
                seen = f"at most {pair.back.top * 1000:.1f} ms before"
                yield back * rate, self._order((a, b), "requires", formula, seen)
        forth = self._upper(pair.forth)
        if forth is None or pair.answered < _FEWEST:
            return
        rate = rhythms[b].count / seconds
        if not orders.by_chance(forth, rate, pair.answered):
            formula = f"pattern: globally: a causes b within {max(math.ceil(forth * 1000), 1)}ms"
            seen = f"at most {pair.forth.top * 1000:.1f} ms after"
            yield forth * rate, self._order((a, b), "causes", formula, seen)

    def _order(self, topics: tuple[str, str], kind: str, formula: str, seen: str) -> Candidate:
        a, b = topics
        rhythms = self._known.rhythms
        less = min((rhythms[a], rhythms[b]), key=lambda rhythm: rhythm.count)
        says = {
            "turns": f"and {b} do not take turns",
            "requires": f"did not come before {b}",
            "causes": f"was not followed by {b}",
        }
        events = {"a": (a, ""), "b": (b, "")}
        return Candidate(a, kind, b, says[kind], seen, self._support(less), formula=formula, events=events)
