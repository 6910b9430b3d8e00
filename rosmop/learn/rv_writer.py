"""Write candidates as `.rv` text that a person edits: a specification for each topic, one for each order."""

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import count, groupby

from rosmop.learn.candidates import Candidate, CandidateSupport, LearntFacts
from rosmop.learn.rv_text import CPP, WORDS, formatted, identifier, number, one_line, short_names
from roswire.counted import counted

_TOLD_EVERY = "1.0"  # seconds
_WIDTH = 104  # the maximum number of columns of a statement


def specifications(
    candidates: Sequence[Candidate], known: LearntFacts
) -> Iterator[tuple[str, str, list[Candidate]]]:
    taken: set[str] = set()
    own = [candidate for candidate in candidates if not candidate.events]
    for topic, group in groupby(own, key=lambda candidate: candidate.topic):
        rows, name = list(group), _new_name(topic, taken)
        yield name, _topic(name, rows, known), rows
    for candidate in candidates:
        if candidate.events:
            name = _new_name(f"{candidate.topic}_{candidate.kind}_{candidate.path}", taken)
            yield name, _order(name, candidate, known.types), [candidate]


def _new_name(text: str, taken: set[str]) -> str:
    name = identifier(text)
    name = f"{name}_topic" if name in WORDS else name
    free = name if name not in taken else next(f"{name}_{n}" for n in count(2) if f"{name}_{n}" not in taken)
    taken.add(free)
    return free


def on(support: CandidateSupport) -> str:
    messages, recordings = counted(support.messages, "message"), counted(support.recordings, "recording")
    return f"{messages}, {support.seconds:g} s, {recordings}"


def _topic(name: str, rows: list[Candidate], known: LearntFacts) -> str:
    checks = [row for row in rows if not row.formula]
    names = short_names(dict.fromkeys(row.path for row in checks if row.path))
    topic = rows[0].topic
    kind, kinds, period = known.types[topic], known.fields[topic], known.rhythms[topic].period
    parameters = ", ".join(f"{_parameter(kinds[path])} {short}" for path, short in names.items())
    fields = ", ".join(f"{path}:{short}" for path, short in names.items())
    lines = [f"// {topic} ({kind}): {on(rows[0].support)}.", f"{name}() {{"]
    scalars = [row for row in checks if not row.folded]
    declared = _once(piece for row in scalars for piece in _filled(row, row.state, names))
    first = _once(piece for row in scalars for piece in _filled(row, row.first, names))
    then = _once(piece for row in scalars for piece in _filled(row, row.then, names))
    own = f"{known.short[topic]}_"
    timed = any("elapsed" in row.condition for row in checks)
    begun = any("begun" in text for row in checks for text in (row.condition, *row.first))
    clock = timed or any("now" in text for row in checks for text in (row.condition, *row.first))
    state = [*declared, *["double {t}before = 0.0;"] * timed, *["bool {t}begun = false;"] * begun]
    lines += [f"    {line.replace('{t}', own)}" for line in state] + [""] * bool(state)
    lines += _wrapped(f"    event message({parameters}) {topic} {kind}")
    lines += _wrapped(f"            '{{{fields}}}' {{")
    body = ["double now = ros::Time::now().toSec();"] * clock
    if timed:
        body.append(f"double elapsed = std::max(now - {{t}}before, {number(period)});")
    body += first
    for row in scalars:
        body += _check(row, names)
    for _, group in groupby((row for row in checks if row.folded), key=lambda row: row.path):
        body += _loop(list(group), names)
    body += [*then, *["{t}before = now;"] * timed, *["{t}begun = true;"] * begun]
    lines += [f"        {line.replace('{t}', own)}" for line in body] + ["    }"]
    for row in rows:
        if row.formula:
            lines += ["", *(f"    {line}" for line in _property(row))]
    return "\n".join([*lines, "}", ""])


def _order(name: str, candidate: Candidate, types: Mapping[str, str]) -> str:
    lines = [f"// {' and '.join(sorted(candidate.topics))}: {on(candidate.support)}.", f"{name}() {{"]
    for event, (topic, pattern) in candidate.events.items():
        lines.append(f"    event {event}() {topic} {types[topic]} '{{{pattern}}}' {{ }}")
    return "\n".join([*lines, "", *(f"    {line}" for line in _property(candidate)), "}", ""])


def _property(row: Candidate) -> list[str]:
    category = "fail" if row.formula.startswith("fsm") else "violation"
    return [_comment(row), row.formula, f'@{category} {{ ROS_WARN("{row.topic} {row.says}"); __RESET; }}']


def _check(row: Candidate, names: Mapping[str, str]) -> list[str]:
    (condition,) = _filled(row, (row.condition,), names)
    size = f"{_short(row, names)}.size()"
    if row.length is not None and row.element is None:
        condition = f"{size} != {row.length} || {condition}"
    elif row.length is not None:
        condition = f"{size} == {row.length} && ({condition})"
    lines = _alarm(condition, [_warning(row, names)])
    # The condition of a constant needs no comment.
    return lines if row.kind == "constant" and not row.widened else [_comment(row), *lines]


def _loop(rows: list[Candidate], names: Mapping[str, str]) -> list[str]:
    lines = [_comment(row) for row in rows] + [
        f"for (int i = 0; i < {_short(rows[0], names)}.size(); i++) {{"
    ]
    for row in rows:
        (condition,) = _filled(row, (row.condition,), names)
        lines += [f"    {line}" for line in _alarm(condition, [_warning(row, names), "break;"])]
    return [*lines, "}"]


def _alarm(condition: str, statements: Sequence[str]) -> list[str]:
    line = f"if ({condition}) {{ {' '.join(statements)} }}"
    if len(line) <= _WIDTH:
        return [line]
    return [f"if ({condition}) {{", *(f"    {statement}" for statement in statements), "}"]


def _warning(row: Candidate, names: Mapping[str, str]) -> str:
    text = f"{formatted(row.topic)} {formatted(row.says)}"
    if not row.shown:
        return f'ROS_WARN_THROTTLE({_TOLD_EVERY}, "{text}");'
    (shown,) = _filled(row, (row.shown,), names)
    form = "%s" if shown.endswith("c_str()") else "%ld" if shown.startswith("(long)") else "%g"
    return f'ROS_WARN_THROTTLE({_TOLD_EVERY}, "{text}: {form}", {shown});'


def _comment(row: Candidate) -> str:
    text = f"// {row.place or row.topic}: {row.seen}"
    if row.widened:
        text += f"; {row.widened}"
    return one_line(text)


def _wrapped(line: str) -> list[str]:
    indent = " " * 12
    return textwrap.wrap(line, 118, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def _once(pieces: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(pieces))


def _filled(row: Candidate, texts: Iterable[str], names: Mapping[str, str]) -> list[str]:
    value = _short(row, names)
    name = value
    if row.element is not None:
        value, name = f"{value}[{row.element}]", f"{value}_{row.element}"
    elif row.folded:
        value = f"{value}[i]"
    filled = [text.replace("{v}", value).replace("{n}", name) for text in texts]
    if row.element is None:
        return filled
    guard = f"if ({_short(row, names)}.size() == {row.length}) {{ "
    return [f"{guard}{text} }}" if value in text and text.endswith((";", "}")) else text for text in filled]


def _short(row: Candidate, names: Mapping[str, str]) -> str:
    return names.get(row.path, "")


def _parameter(kind: str) -> str:
    if kind in ("time", "duration"):
        return f"ros::{kind.capitalize()}"
    if kind == "length":
        return "auto"
    name = kind.removesuffix("[]")
    return f"std::vector<{CPP[name]}>" if kind.endswith("[]") else CPP[name]
