"""``mtl``: metric temporal logic over the past, in words, with closed time bounds.

``once[0,500ms] a``, ``historically[…] a``, ``a since[…] b``, ``previously[…] a``; without bounds an
operator means ``[0,inf]``. Pointwise: a formula is asked only at events, and its operators see events only,
at the times at which they were received. The category is ``validation`` where the formula holds at this
event, ``violation`` where not.

Future operators are read, and refused: they are not supported yet.
"""

from appliance.rosmop.logics.formula import NOT, Level, Syntax, boolean_levels, nodes, read_formula
from appliance.rosmop.logics.interface import CompiledProperty, Source
from appliance.rosmop.logics.past import compile_past

_PAST = ("previously", "once", "historically", "since")
_FUTURE = ("next", "eventually", "always", "until")
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
    unary={**NOT, **{word: word for word in (*_PAST[:3], *_FUTURE[:3])}},
    levels=boolean_levels([Level({"since": "since", "until": "until"}, "left")]),
    bounded=frozenset((*_PAST, *_FUTURE)),
    refused={symbol: f"is written `{word}` in mtl" for symbol, word in _SYMBOLS.items()},
)


def compile_mtl(source: Source) -> CompiledProperty:
    """Compile an ``mtl`` formula. Raises FormulaError."""
    formula = read_formula(source, SYNTAX)
    for node in nodes(formula):
        if node.operator in _FUTURE:
            raise source.error(
                node.offset,
                f"`{node.operator}` is about the future, which mtl does not support yet; "
                f"write a formula about the past ({', '.join(_PAST)}), or a `pattern` with a deadline",
            )
    return compile_past(source, formula)
