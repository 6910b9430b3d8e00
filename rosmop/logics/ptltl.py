"""``ptltl``: past-time linear temporal logic, as MOP's PTLTL plugin reads it."""

from rosmop.logics.formula import NOT, Level, Syntax, boolean_levels, read_formula
from rosmop.logics.interface import CompiledProperty, Source
from rosmop.logics.past_monitors import compile_past

_FUTURE = "is a future operator; write `ltl:` as the logic, or a past operator: (*) <*> [*] S"

SYNTAX = Syntax(
    unary={**NOT, "(*)": "previously", "~(*)": "dual previously", "<*>": "once", "[*]": "historically"},
    levels=boolean_levels([Level({"S": "since", "~S": "dual since"}, "left")]),
    refused={
        **dict.fromkeys(("[]", "<>", "o", "~o", "U", "~U", "R"), _FUTURE),
        "~": "has no meaning here; write `!` for a negation",
    },
)


def compile_ptltl(source: Source) -> CompiledProperty:
    return compile_past(source, read_formula(source, SYNTAX))
