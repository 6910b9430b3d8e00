"""The logics there are, by name. Another logic is one more file and one more row here."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from rosmop.form.positions import Finding, Position
from rosmop.logics.cfg import compile_cfg
from rosmop.logics.ere import compile_ere
from rosmop.logics.fsm import compile_fsm
from rosmop.logics.interface import CompiledProperty, Compiler, FormulaError, Source
from rosmop.logics.lexer import suggestion
from rosmop.logics.ltl import compile_ltl
from rosmop.logics.mtl import compile_mtl
from rosmop.logics.pattern import compile_pattern
from rosmop.logics.ptcaret import compile_ptcaret
from rosmop.logics.ptltl import compile_ptltl
from rosmop.logics.srs import compile_srs
from rosmop.logics.tfsm import compile_tfsm

LOGICS: Mapping[str, Compiler] = MappingProxyType(
    {
        "fsm": compile_fsm,
        "tfsm": compile_tfsm,
        "ere": compile_ere,
        "ltl": compile_ltl,
        "ptltl": compile_ptltl,
        "cfg": compile_cfg,
        "mtl": compile_mtl,
        "pattern": compile_pattern,
        "srs": compile_srs,
        "ptcaret": compile_ptcaret,
    }
)

_REFUSED = {
    "dl": "`dL` (differential dynamic logic) is not supported: what is proved with it is proved elsewhere. Write the"
    " condition that the proof gives as a test of numbers in an event, and what must follow in time as `mtl` or"
    " `pattern`"
}


def compile_property(
    logic: str, formula: str, events: Sequence[str], origin: Position, logic_position: Position | None = None
) -> CompiledProperty:
    """Compile the formula of a property.

    ``logic`` in any case; ``events`` in source order, each name once; ``origin`` is where the formula
    begins and ``logic_position`` where the name of the logic stands (``origin`` if not given). Raises
    FormulaError.
    """
    compiler = LOGICS.get(logic.lower())
    if compiler is None:
        text = (
            _REFUSED.get(logic.lower())
            or f"there is no logic `{logic}`{suggestion(logic.lower(), list(LOGICS))}"
        )
        raise FormulaError([Finding(logic_position or origin, "error", text)])
    source = Source(logic.lower(), formula, tuple(events), origin)
    if not events:
        raise source.error(0, "a property needs at least one event in its specification")
    return compiler(source)
