"""Compile properties by the names of their logics."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from rosmop.form.findings import Diagnostic, Position
from rosmop.logics.bounded import BoundedProperty
from rosmop.logics.cfg import GrammarProperty, compile_cfg
from rosmop.logics.ere import compile_ere
from rosmop.logics.fsm import compile_fsm
from rosmop.logics.interface import CompiledProperty, FiniteProperty, FormulaError, Logic, Source
from rosmop.logics.lexer import suggestion
from rosmop.logics.ltl import compile_ltl
from rosmop.logics.mtl import compile_mtl
from rosmop.logics.past_monitors import ClockedPastProperty, PastProperty
from rosmop.logics.pattern import TimedPattern, compile_pattern
from rosmop.logics.ptcaret import CaretProperty, compile_ptcaret
from rosmop.logics.ptltl import compile_ptltl
from rosmop.logics.srs import RewritingProperty, compile_srs
from rosmop.logics.tfsm import TimedStateMachine, compile_tfsm

LOGICS: Mapping[str, Logic] = MappingProxyType(
    {
        "fsm": Logic(compile_fsm, has_states=True),
        "tfsm": Logic(compile_tfsm, (TimedStateMachine,), has_states=True),
        "ere": Logic(compile_ere, failure="fail"),
        "ltl": Logic(compile_ltl, suppresses=True, failure="violation"),
        "ptltl": Logic(compile_ptltl, (FiniteProperty, PastProperty), suppresses=True, failure="violation"),
        "cfg": Logic(compile_cfg, (FiniteProperty, GrammarProperty), failure="fail"),
        "mtl": Logic(
            compile_mtl,
            (FiniteProperty, ClockedPastProperty, PastProperty, BoundedProperty),
            suppresses=True,
            failure="violation",
        ),
        "pattern": Logic(
            compile_pattern, (FiniteProperty, TimedPattern), suppresses=True, failure="violation"
        ),
        "srs": Logic(compile_srs, (RewritingProperty,)),
        "ptcaret": Logic(compile_ptcaret, (CaretProperty,), implicit_events=("begin", "end")),
    }
)

_REFUSED = {
    "dl": "`dL` (differential dynamic logic) is not supported: prove with another tool. Write the proved condition as"
    " a numeric test in an event, and its time limits as `mtl` or `pattern`"
}


def compile_property(  # noqa: PLR0917  parts of a property, in the order of the text
    logic: str,
    formula: str,
    events: Sequence[str],
    origin: Position,
    logic_position: Position | None = None,
    times: Mapping[str, int] | None = None,
) -> CompiledProperty:
    """Compile a property. Raises `FormulaError`.

    The case of ``logic`` does not matter. ``events`` are in source order, each name once. ``origin`` is the position
    of the formula. ``times`` are the nanoseconds of names that stand for time bounds.
    """
    found = LOGICS.get(logic.lower())
    if found is None:
        text = (
            _REFUSED.get(logic.lower()) or f"unknown logic `{logic}`{suggestion(logic.lower(), list(LOGICS))}"
        )
        raise FormulaError([Diagnostic(logic_position or origin, "error", text)])
    source = Source(logic.lower(), formula, tuple(events), origin, found.suppresses, dict(times or {}))
    if not events:
        raise source.error(0, "a property needs at least one event in its specification")
    return found.compile(source)
