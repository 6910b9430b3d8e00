"""Presets with one fault in their text: a changed comparison, operator, sign or bound, a statement that is left out, or
two fields that are swapped.

The module of the faulty text is compared with the form of the right one. Timers are not in the module, so the event
`tick` at the end of a text gets no fault.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

from rosmop.fast.batch_codegen import written_of
from rosmop.form.compiled import Compiled, EventCode
from rosmop.form.specification_groups import groups
from rosmop.prove.equality import LEFT, Validation
from rosmop.tests.prove.module_mutants import compiled
from rosmop.tests.random_specifications import definitions
from roswire.standard import standard_definitions

_COMPARED = {"<=": "<", "<": "<=", ">=": ">", ">": ">=", "==": "!=", "!=": "=="}
_CALCULATED = {"&&": "||", "||": "&&", "+": "-", "-": "+", "*": "/", "/": "*"}
_WORDS = re.compile(r" (<=|>=|<|>|==|!=|&&|\|\||[-+*/]) ")
_SIGN = re.compile(r"!(?=[\w(])|(?<=[ (])-(?=\w)")
_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.])")
_STATEMENT = re.compile(r"(?m)(?<=[{;\n]) *\w+ = [^;{}\n]+;|\bSTOP;")
_FIELDS = re.compile(r"([\w.]+):(\w+), ([\w.]+):(\w+)")
_PASSED_OVER = re.compile(r"ROS_|const |safe |^    (double|int|bool) \w+ = ")
"""Lines of output and constants, which have no address in both modules, and first values, which Python sets."""

_Key = TypeVar("_Key")
_CHANGES: Sequence[tuple[re.Pattern[str], Callable[[re.Match[str]], str]]] = (
    (_WORDS, lambda found: f" {(_COMPARED | _CALCULATED)[found[1]]} "),
    (_SIGN, lambda found: ""),
    (_NUMBER, lambda found: str(float(found[0]) + 1) if "." in found[0] else str(int(found[0]) + 1)),
    (_STATEMENT, lambda found: ""),
    (_FIELDS, lambda found: f"{found[1]}:{found[4]}, {found[3]}:{found[2]}"),
)


def faults(text: str) -> Iterator[tuple[str, str]]:
    """Yield each fault, as the right line with the place marked by `»`, and the text with this fault."""
    head, _, rest = text.partition("\n} {\n")
    body, tick, end = rest.partition("    event tick")
    for pattern, other in _CHANGES:
        for found in pattern.finditer(body):
            begin = found.end() - len(found[0].lstrip())
            first, last = body.rfind("\n", 0, begin) + 1, body.find("\n", found.end())
            if _PASSED_OVER.search(body[first:last]) or "//" in body[first:begin]:
                continue
            line, _, _ = f"{body[first:begin]}»{body[begin:last]}".partition("//")
            new = body[: found.start()] + other(found) + body[found.end() :]
            yield line.strip(), head + "\n} {\n" + new + tick + end


def difference(good: str, faulty: str) -> str | None:
    """Return what differs between the form of a text and the module of another one, as a run shows."""
    validation, events = _validation(good, faulty, 0)
    few = (validation.difference(*event, 200) for event in events)
    every = (validation.difference(*event) for event in events)
    return next((one for one in few if one not in (None, LEFT)), None) or next(filter(None, every), None)


def answers(good: str, faulty: str, patience: float) -> list[str]:
    """Return the answers of the prover for the form of a text and the module of another one."""
    validation, events = _validation(good, faulty, patience)
    return [validation.finding(topic, event.name, event, place).answer for topic, event, place in events]


def _validation(
    good: str, faulty: str, patience: float
) -> tuple[Validation, list[tuple[str, EventCode, int]]]:
    known = standard_definitions().merge(definitions())
    form, other = (compiled(text, known) for text in (good, faulty))
    [group] = groups(form.specifications)
    right, wrong = written_of(form), written_of(other)
    [own] = wrong.cells
    variables = {
        mine: own.variables[its]
        for mine, its in zip(_variables(form), _variables(other), strict=True)
        if its in own.variables
    }
    module = replace(
        wrong,
        lines=right.lines,
        cells=[replace(own, variables=variables)],
        throttles=_renamed(right.throttles, wrong.throttles),
        budgets=_renamed(right.budgets, wrong.budgets),
        senders=_renamed(right.senders, wrong.senders),
    )
    events = [
        (topic, form.specifications[number].events[index], place)
        for (topic, _), numbers in zip(group.component.topics, group.events, strict=True)
        for place, (number, index) in enumerate(numbers)
    ]
    return Validation(form, module, patience), events


def _variables(code: Compiled) -> list[str]:
    """Return the variables of the text and given constants; those of noted comparisons have no effect."""
    [specification] = code.specifications
    return [*specification.variables.values(), *(given.code for given in specification.givens)]


def _renamed(names: Mapping[_Key, int], addresses: Mapping[_Key, int]) -> dict[_Key, int]:
    """Return the addresses by the names of the right text; a left-out statement changes the numbers in names."""
    return dict(zip(names, addresses.values(), strict=True))
