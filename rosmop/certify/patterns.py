"""Translate patterns without a time bound to equivalent formulas about the future (after Dwyer; HPL).

`W` is "until, or forever". These formulas hold inside a scope that `q` closes (`false` if no event closes it), from
its first event on:

    no c            not c  W  q
    some c          not q  U  (c and not q);  open to the end: eventually c
    c causes d      (c => next (not q  U  (d and not q)))  W  q
    c requires d    not c  W  ((d and not c) or q)
    c forbids d     (c => next (not d  W  q))  W  q

No event answers itself. An event that closes the scope is not inside the scope.
"""

from collections.abc import Sequence

from rosmop.certify.formula_reader import Node, UnsupportedFormulaError, WordReader

_FALSE: Node = ("false",)


def meaning(formula: str, events: Sequence[str]) -> Node:
    words = WordReader(formula, (":", "(", ")"))
    opens, closes = _scope(words, events)
    words.expect(":")
    first = words.take()
    if first in ("no", "some") and words.word not in ("causes", "requires", "forbids"):
        kind, c, d = first, _event(words.take(), events), _FALSE
    else:
        kind, c, d = words.take(), _event(first, events), _event(words.take(), events)
    words.end()
    inside = _inside(kind, c, d, closes or _FALSE)
    if opens is None:
        return inside
    if opens == closes:
        raise UnsupportedFormulaError("one event opens and closes the scope, which ltl cannot express")
    opened = _weak(("not", opens), ("and", opens, ("next", inside)))
    if closes is None:
        return opened
    return ("and", opened, ("always", ("implies", closes, ("next", opened))))


def _scope(words: WordReader, events: Sequence[str]) -> tuple[Node | None, Node | None]:
    word = words.take()
    if word == "globally":
        return None, None
    if word == "until":
        return None, _event(words.take(), events)
    if word != "after":
        raise UnsupportedFormulaError(f"{word!r} is not a scope")
    opens = _event(words.take(), events)
    return opens, _event(words.take(), events) if words.accept("until") else None


def _event(word: str, events: Sequence[str]) -> Node:
    if word not in events:
        raise UnsupportedFormulaError(f"{word!r} is not an event")
    return ("event", word)


def _weak(left: Node, right: Node) -> Node:
    return ("release", right, ("or", left, right))


def _inside(kind: str, c: Node, d: Node, q: Node) -> Node:
    open_still: Node = ("not", q)
    match kind:
        case "no":
            return _weak(("not", c), q)
        case "some":
            return ("until", open_still, ("and", c, open_still))
        case "causes":
            return _weak(("implies", c, ("next", ("until", open_still, ("and", d, open_still)))), q)
        case "requires":
            return _weak(("not", c), ("or", ("and", d, ("not", c)), q))
        case "forbids":
            return _weak(("implies", c, ("next", _weak(("not", d), q))), q)
    raise UnsupportedFormulaError(f"{kind!r} is not a pattern")
