"""``mtl``: metric temporal logic, in words, with closed time bounds.

The semantics is pointwise: a formula is evaluated only at events, and its operators see only events, at their times
of reception. A verdict comes once it is certain, at the latest when the bounds have passed.
"""

from rosmop.logics.bounded import BoundedProperty
from rosmop.logics.formula import NOT, Level, Syntax, boolean_levels, nodes, read_formula
from rosmop.logics.interface import CompiledProperty, Source
from rosmop.logics.past_monitors import compile_past

_PAST = ("previously", "once", "historically", "since")
FUTURE = ("next", "eventually", "always", "until")
_SYMBOLS = {
    "(*)": "previously",
    "<*>": "once",
    "[*]": "historically",
    "S": "since",
    "[]": "always",
    "<>": "eventually",
    "o": "next",
    "U": "until",
}

SYNTAX = Syntax(
    unary={**NOT, **{word: word for word in (*_PAST[:3], *FUTURE[:3])}},
    levels=boolean_levels([Level({"since": "since", "until": "until"}, "left")]),
    bounded=frozenset((*_PAST, *FUTURE)),
    refused={symbol: f"is written `{word}` in mtl" for symbol, word in _SYMBOLS.items()},
)


def compile_mtl(source: Source) -> CompiledProperty:
    formula = read_formula(source, SYNTAX)
    future = [node for node in nodes(formula) if node.operator in FUTURE]
    for node in future:
        if node.bounds is None or node.bounds[1] is None:
            raise source.error(
                node.offset,
                f"`{node.operator}` has no upper bound, so its verdict might never be reached; write"
                f" `{node.operator}[0,10s]` with your time limit, or `ltl` for events that may come at any time",
            )
    return BoundedProperty(source, formula) if future else compile_past(source, formula)
