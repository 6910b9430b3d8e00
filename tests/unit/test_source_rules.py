"""Rules on the source, in one pass over all files: a file that changed is parsed once, and every rule sees its nodes.

A row of `RULES` has the folders, a function that yields facts of a file, a function that judges the facts of all
files, and sources that the rule must reject and accept.
"""

import ast
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

from distribution import fact_cache
from distribution.fact_cache import facts_of_files, name_of, nodes
from tests.support.sources import ROOT
from tests.unit import test_plain_english
from tests.unit.test_plain_english import FOLDERS, bad_habits, said_in

PRODUCT = ("appliance/", "rosmop/", "roswire/")
FLEET = "fleet/src/"
WITH_FLEET = (*PRODUCT, FLEET)
LANGUAGE_TESTS = "rosmop/tests/"


class Source(NamedTuple):
    path: str
    text: str
    nodes: Sequence[ast.AST]


class Seen(NamedTuple):
    path: str
    line: int
    what: str


Judge = Callable[[Sequence[Seen]], Iterable[str]]


class Rule(NamedTuple):
    folders: tuple[str, ...]
    see: Callable[[Source], Iterator[tuple[int, str]]]
    judge: Judge
    wrong: Sequence[str] = ()
    right: Sequence[str] = ()


def forbid(instead: str) -> Judge:
    return lambda seen: [f"{one.path}:{one.line}: {one.what}: {instead}" for one in seen]


def _is_here(line: str) -> bool:
    folder = re.match(r"appliance/features/\w+/", line)
    return folder is None or (ROOT / folder[0]).is_dir()


def exactly(listed: Iterable[str], instead: str) -> Judge:
    """Require the listed facts and no others. Facts of a feature may stay listed after its folder was removed."""
    allowed = {one for one in listed if _is_here(one)}

    def judge(seen: Sequence[Seen]) -> Iterator[str]:
        found = {one.what for one in seen}
        yield from (
            f"{one.path}:{one.line}: {one.what}: {instead}" for one in seen if one.what not in allowed
        )
        yield from (
            f"test_source_rules.py: {one} is listed but no longer found: remove it" for one in allowed - found
        )

    return judge


# --- malformed data, descriptors ---


def narrow_handlers(source: Source) -> Iterator[tuple[int, str]]:
    if "MsgspecError" not in source.text and "DecodeError" not in source.text:
        return
    raised = {id(part) for one in source.nodes if isinstance(one, ast.Raise) for part in nodes(one)}
    for node in source.nodes:
        match node:
            case ast.Attribute(attr="MsgspecError" | "DecodeError" as name) if id(node) not in raised:
                yield node.lineno, name


def closed_descriptors(source: Source) -> Iterator[tuple[int, str]]:
    if "os.close" not in source.text:
        return
    for function in source.nodes:
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        inside = nodes(function)
        reset = {
            ast.unparse(target)
            for node in inside
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.UnaryOp | ast.Constant)
            for target in node.targets
        }
        for node in inside:
            match node:
                case ast.Call(
                    func=ast.Attribute(value=ast.Name(id="os"), attr="close"), args=[ast.Attribute() as kept]
                ) if ast.unparse(kept) not in reset:
                    yield node.lineno, ast.unparse(kept)


# --- clocks ---

DIRECT = {
    "appliance/base/clock.py": "offers the clocks of the operating system to the rest",
    "appliance/features/standby/witness/enforcement.py": "runs on a machine without the appliance",
    "appliance/features/standby/witness/firewall.py": "runs on a machine without the appliance",
    "appliance/features/standby/witness/following.py": "runs on a machine without the appliance",
    "appliance/features/standby/witness/serving.py": "runs on a machine without the appliance",
}
_CLOCKS = {"time", "time_ns", "localtime", "gmtime", "ctime"} | {
    f"{clock}{unit}" for clock in ("monotonic", "perf_counter", "clock_gettime") for unit in ("", "_ns")
}


def direct_clocks(source: Source) -> Iterator[tuple[int, str]]:
    """Find reads of a clock that bypass `base/clock.py`, whose clocks a test can set."""
    for node in source.nodes:
        match node:
            case ast.ImportFrom(module="time"):  # a bare `time()` does not reveal which clock is used
                yield node.lineno, source.path
            case ast.Attribute(value=ast.Name(id="time"), attr=name) if name in _CLOCKS:
                yield node.lineno, source.path
            case ast.Attribute(
                value=ast.Name(id=of) | ast.Attribute(attr=of), attr="now" | "utcnow" | "today"
            ) if of in ("datetime", "date"):
                yield node.lineno, source.path


# --- pages and prose ---


def lost_cancellations(source: Source) -> Iterator[tuple[int, str]]:
    """Find `asyncio.wait_for`, which in Python 3.11 loses a cancellation that comes with the event."""
    for node in source.nodes:
        match node:
            case ast.Attribute(value=ast.Name(id="asyncio"), attr="wait_for"):
                yield node.lineno, "asyncio.wait_for"


def printed(source: Source) -> Iterator[tuple[int, str]]:
    for node in source.nodes:
        match node:
            case ast.Constant(value=str(text)):
                pass
            case ast.JoinedStr(values=values):
                text = "\0".join(str(value.value) for value in values if isinstance(value, ast.Constant))
            case _:
                continue
        if " " in text:
            yield node.lineno, text.encode(errors="replace").decode()  # lone surrogates


def quoted(seen: Sequence[Seen]) -> Iterator[str]:
    """Require that the tables of messages quote only those that the program can print."""
    page = (ROOT / "docs/troubleshooting.md").read_text()
    cells = re.findall(r"^\| ([^|]*`[^|]*) \|", page, re.MULTILINE)
    messages = [piece for cell in cells for piece in re.findall(r"`([^`(]+)`", cell) if " " in piece]
    # A script prints the beginning of these, the appliance the end.
    tunnels = (ROOT / "docs/reference/tunnels.md").read_text()
    ends = re.findall(r"^\| `[^`]*… ([a-z][^`…A-Z0-9]{12,})` \|", tunnels, re.MULTILINE)
    assert (len(messages) > 25, len(ends)) == (True, 3)
    program = "\n".join(one.what for one in seen)
    for page_name, one in [
        *(("troubleshooting", message) for message in messages),
        *(("reference/tunnels", end) for end in ends if _is_here("appliance/features/tunnels/")),
    ]:
        if one not in program:
            yield f"docs/{page_name}.md: {one!r} is in no string of the appliance: quote what it prints"


def habits(source: Source) -> Iterator[tuple[int, str]]:
    yield from bad_habits(said_in(source.text, source.nodes))


def shown_habits(source: Source) -> Iterator[tuple[int, str]]:
    parts = {id(part) for node in source.nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in source.nodes:
        match node:
            case ast.Constant(value=str(text)) if id(node) not in parts:
                pass
            case ast.JoinedStr(values=values):
                text = "".join(
                    str(part.value) if isinstance(part, ast.Constant) else _word(part) for part in values
                )
            case _:
                continue
        if text.count(" ") > 1 and not text.startswith("ROSMaster port "):  # the original ROSRV printed it so
            yield from ((node.lineno, what) for _line, what in bad_habits(text))


MISCOUNTED = re.compile(
    r" (?:(?:more|further|new|other) )?(?:arguments|bundles|calls|cases|changes|checkpoints|commands|"
    r"connections|denials|elements|errors|events|files|findings|forks|gaps|hosts|lines|messages|migrations|monitors|nodes|"
    r"parts|ports|processes|records|registrations|reports|restarts|robots|rows|rules|searches|segments|sessions|times|"
    r"topics|transitions|trials|values|warnings)\b"
)
LIMIT = re.compile(r"[A-Z_]{3,}|most|limit|bound|longest|least|range")
"""Names of numbers that are never 1."""
PLURAL = re.compile(r"[^.,;:(]*?(?:, which)? (?:are|do|have|keep|name|use|were)\b")


def miscounted(source: Source) -> Iterator[tuple[int, str]]:
    chosen = {
        id(part) for node in source.nodes if isinstance(node, ast.IfExp) for part in (node.body, node.orelse)
    }
    for node in source.nodes:
        if not isinstance(node, ast.JoinedStr) or id(node) in chosen:
            continue
        shared = False  # with another number, as in `1 of 2 hosts` and `1 host and 1 node`
        for number, behind in pairwise(node.values):
            match number, behind:
                case ast.Constant(value=str(text)), _:
                    shared = text.endswith((" of ", " and "))
                case (
                    ast.FormattedValue(value=ast.Call(func=ast.Name(id="counted")) as value),
                    ast.Constant(value=str(text)),
                ) if PLURAL.match(text) and not shared:
                    yield node.lineno, f"{{{ast.unparse(value)}}}{text[:30]}"
                case ast.FormattedValue(value=value), ast.Constant(value=str(text)):
                    if MISCOUNTED.match(text) and not LIMIT.search(ast.unparse(value)):
                        yield node.lineno, f"{{{ast.unparse(value)}}}{text[:30]}"


def _word(replaced: ast.expr) -> str:
    """Return a word that replaces a field of an f-string, such as `nothing` of `{found or 'nothing'}`."""
    words = (node.value for node in ast.walk(replaced) if isinstance(node, ast.Constant))
    return next((word for word in words if isinstance(word, str) and word.isalpha()), "X")


RULES = {
    "decoding": Rule(
        WITH_FLEET, narrow_handlers, forbid("catch ValueError, which includes UnicodeDecodeError"),
        ["try: pass\nexcept (OSError, msgspec.DecodeError): pass"], ["raise msgspec.DecodeError"],
    ),
    "descriptors": Rule(
        PRODUCT, closed_descriptors, forbid("set it to -1 or None: the next open file gets its number"),
        ["def close(self):\n    os.close(self._lock)"],
        ["def close(self):\n    os.close(self._lock)\n    self._lock = -1"],
    ),
    "clocks": Rule(
        ("appliance/", FLEET), direct_clocks, exactly(DIRECT, "read it with appliance/base/clock.py"),
        ["time.monotonic_ns()", "datetime.datetime.now()", "from time import time", "date.today()"],
    ),
    "cancellations": Rule(
        WITH_FLEET, lost_cancellations, forbid("use asyncio.timeout: a task that is cancelled must end"),
        ["await asyncio.wait_for(event.wait(), 1.0)"], ["await condition.wait_for(ready)"],
    ),
    "messages": Rule(("appliance/",), printed, quoted),
    "English": Rule(FOLDERS, habits, forbid("plain English")),
    "English that is shown": Rule(
        (*WITH_FLEET, "distribution/", "examples/", "benchmarks/"), shown_habits, forbid("plain English"),
        ["raise ValueError(f'{name} is no group of hosts')", "say(f'{host or \"nobody\"} holds the group now')"],
        ["raise ValueError(f'{name} is not a group')"],
    ),
    "counted": Rule(
        WITH_FLEET, miscounted,
        forbid("counted(number, noun) or counted(number, 'noun is', 'nouns are') of appliance/base/counted.py or"
               " roswire/counted.py: there may be one"),
        ["f'{self.left} more errors are not shown'", "f'{len(found)} hosts'", "f'{counted(n, \"host\")} of a are up'"],
        ["f'more than {_MAX} hosts'", "'1 host' if n == 1 else f'{n} hosts'", "f'{counted(n, \"host\")} left'",
         "f'{counted(n, \"host\")} and {counted(n, \"node\")} are up'"],
    ),
}  # fmt: skip


def test_the_source_keeps_its_rules() -> None:
    seen: dict[str, list[Seen]] = {name: [] for name in RULES}
    paths = sorted({path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")})
    code = (__file__, test_plain_english.__file__, fact_cache.__file__)
    for path, facts in facts_of_files(dict[str, list[tuple[int, str]]], seen_in, paths, code=code).items():
        for name, rows in facts.items():
            seen[name] += (Seen(path, line, what) for line, what in rows)
    assert len(seen["messages"]) > 1000
    found = [finding for name, rule in RULES.items() for finding in rule.judge(seen[name])]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_a_rule_finds_what_it_forbids(rule: Rule) -> None:
    """A rule that finds nothing would never fail."""
    for text in rule.wrong:
        assert findings(rule, text), text
    for text in rule.right:
        assert not findings(rule, text), text


def parsed(path: str, text: str) -> Source:
    return Source(path, text, nodes(ast.parse(text)))


def seen_in(path: Path) -> dict[str, list[tuple[int, str]]]:
    source = parsed(name_of(path), path.read_text())
    return {name: list(rule.see(source)) for name, rule in RULES.items() if applies(rule, source.path)}


def applies(rule: Rule, path: str) -> bool:
    return path.startswith(rule.folders) and not path.startswith(LANGUAGE_TESTS)


def findings(rule: Rule, *texts: str) -> list[str]:
    sources = [parsed(f"example{number}.py", text) for number, text in enumerate(texts)]
    seen = [Seen(source.path, line, what) for source in sources for line, what in rule.see(source)]
    return [finding for finding in rule.judge(seen) if "example" in finding]
