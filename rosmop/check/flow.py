"""Follow values through the form of a specification: an abstract interpretation with small lattices.

A value is known, or unknown. In a *scenario* one source is NaN (a field of a message, a division, a root), and
everything else is unknown: comparisons with NaN are known then, and a value notes the places where NaN decided it.
Without a scenario the same walk finds on which inputs values, drops and assignments depend.

States at one place are joined, apart from those whose message was dropped or replaced. Loops are repeated until
nothing changes, and helper functions are followed into. An unknown number may be NaN.
"""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from rosmop.check.abstract_values import (
    ANY,
    CALL,
    CAST,
    COMPARISON,
    DROPPED,
    EMPTY,
    LIVE,
    NAN,
    PASSES,
    REPLACED,
    SENT,
    TEST,
    UNKNOWN,
    AbstractParts,
    AbstractValue,
    Path,
    PathState,
    Places,
    is_tainted,
    join,
    key_of,
    merge,
    negate,
    of_compared,
    of_number,
    shared_of,
    unset,
    why_of,
)
from rosmop.check.flow_work import BlockFacts, FlowWork, PureCall
from rosmop.form import nodes
from rosmop.types import value_types

_DEPTH = 12
_ROUNDS = 6
_WIDENED = 3
"""The round of a loop after which a number that still changes is unknown."""


class Exit(NamedTuple):
    """How a block ends: `next`, `break`, `continue`, `return` or `leave`, and the fate of the message."""

    how: str
    fate: str
    happened: bool = True


Exits = dict[Exit, PathState]


class FlowAnalysis:
    """Follows the functions of one specification. `source` is the site of the operation that is NaN, if any."""

    def __init__(
        self,
        functions: Mapping[str, nodes.Function],
        fields: Mapping[str, str],
        topic: str | None,
        *,
        work: "FlowWork",
        source: int | None = None,
    ) -> None:
        """`fields` maps the flags of assigned fields to their variables, and `topic` is that of the message."""
        self._functions = functions
        self._fields = fields
        self._topic = topic
        self._work = work
        self._source = source
        self._site = -1
        self._depth = 0
        self.restricts = False
        """Whether it restricts the message that the event happens."""
        self.given: dict[str, AbstractValue] = {}
        """The values of fields that are read, by name."""
        self.drops: dict[int, frozenset[str]] = {}
        self.compared: set[str] = set()
        """The inputs that are compared, bounded or converted to integers."""
        self.operations: set[int] = set()
        """The sites of operations that may be NaN though their operands are not."""
        self.published: list[AbstractValue] = []
        self._most: dict[str, int] = {}
        """The largest number that a `Select` assigns to a variable."""

    def event(self, function: nodes.Function, state: PathState) -> Exits:
        exits = self._block(function.body, state)
        return {
            Exit("leave", way.fate, way.happened): merge(
                one
                for other, one in exits.items()
                if (other.fate, other.happened) == (way.fate, way.happened)
            )
            for way in exits
        }

    # Statements

    def _block(self, body: Sequence[nodes.Statement], state: PathState) -> Exits:
        live, exits = {state.fate: state}, Exits()
        for number, statement in enumerate(body):
            following: dict[str, PathState] = {}
            for each in live.values():
                self._site = statement.site
                self._work.spend()
                rest = body[number + 1 :] if isinstance(statement, nodes.If) else ()
                for way, after in self._statement(statement, each, rest).items():
                    if way.how == "next":
                        _add(following, way.fate, after)
                    else:
                        _add(exits, way, after)
            live = following
            if not live:
                break
        for fate, after in live.items():
            _add(exits, Exit("next", fate), after)
        return exits

    def _statement(self, node: nodes.Statement, state: PathState, rest: Sequence[nodes.Statement]) -> Exits:
        if isinstance(node, nodes.If):
            return self._if(node, state, rest)
        made: Exits = _STATEMENTS.get(type(node), FlowAnalysis._next)(self, node, state)
        return made

    def _next(self, _: object, state: PathState) -> Exits:
        return {Exit("next", state.fate): state}

    def _evaluate(self, node: nodes.Evaluate, state: PathState) -> Exits:
        self.value(node.value, state)
        return self._next(node, state)

    def _endless(self, node: nodes.Loop, state: PathState) -> Exits:
        return self._loop(state, lambda inner: self._block(node.body, inner), ends=False)

    def _for_each(self, node: nodes.ForEach, state: PathState) -> Exits:
        of = node.values.type
        kind = of.element if isinstance(of, value_types.VectorType) else value_types.CHAR
        element = self.value(node.values, state).part(ANY, kind)

        def each(inner: PathState) -> Exits:
            inner.values[node.name] = element
            return self._block(node.body, inner)

        return self._loop(state, each, ends=True)

    def _break(self, _: nodes.Break, state: PathState) -> Exits:
        return {Exit("break", state.fate): state}

    def _continue(self, _: nodes.Continue, state: PathState) -> Exits:
        return {Exit("continue", state.fate): state}

    def _select(self, node: nodes.Select, state: PathState) -> Exits:
        value = self.value(node.value, state)
        found: Any = UNKNOWN
        if value.is_number and not value.is_nan:
            found = dict(node.table).get(int(value.known), node.default)
        self._most[node.name] = max(node.default, *(number for _, number in node.table))
        state.set(node.name, value._replace(known=found))
        return self._next(node, state)

    def _return(self, node: nodes.Return, state: PathState) -> Exits:
        value = self.value(node.value, state)
        if node.references:
            value = AbstractValue(
                (value, *(self._read(name, state) for name in node.references)), inputs=value.inputs
            )
        elif value.is_constant or value.known is UNKNOWN:
            value = value._replace(why=value.why | state.control)
        state.result = value._replace(inputs=value.inputs | state.inputs)
        return {Exit("return", state.fate): state}

    def _leave(self, node: nodes.Leave, state: PathState) -> Exits:
        return {Exit("leave", state.fate, node.happened is not False): state}

    def _drop(self, node: nodes.Drop, state: PathState) -> Exits:
        return self._suppress(node, state, DROPPED)

    def _stop(self, node: nodes.StopMessage, state: PathState) -> Exits:
        if any(safe.topic == self._topic for safe in node.safes):
            return self._suppress(node, state, REPLACED)
        return self._suppress(node, state, SENT if state.fate == LIVE else state.fate)

    def _publish(self, node: nodes.Publish, state: PathState) -> Exits:
        self.published.append(self.value(node.value, state))
        state.spoke = True
        return self._next(node, state)

    def _read_numbers(self, node: nodes.ReadNumbers, state: PathState) -> Exits:
        for name, _, _ in node.fields:
            state.values[name] = self.given.get(name, AbstractValue())
        return self._next(node, state)

    def _read_value(self, node: nodes.ReadValue, state: PathState) -> Exits:
        state.values[node.name] = self.given.get(node.name, AbstractValue())
        return self._next(node, state)

    def _write_back(self, node: nodes.WriteBack, state: PathState) -> Exits:
        if state.fate in PASSES:
            return self._next(node, state)
        return {Exit("leave", state.fate): state}

    def _suppress(self, node: nodes.Drop | nodes.StopMessage, state: PathState, fate: str) -> Exits:
        self.drops[node.site] = self.drops.get(node.site, EMPTY) | state.inputs
        state.fate = fate
        return {Exit("next", fate): state}

    def _if(self, node: nodes.If, state: PathState, rest: Sequence[nodes.Statement]) -> Exits:
        test = self.value(node.test, state)
        control, inputs = state.control, state.inputs
        exits: Exits = {}
        for truth, taken, other in ((True, node.yes, node.no), (False, node.no, node.yes)):
            if test.known is not UNKNOWN and bool(test.known) is not truth:
                continue
            inner = state.branch()
            ends = taken and isinstance(taken[-1], nodes.Break | nodes.Continue | nodes.Return | nodes.Leave)
            untaken = self._work.others.setdefault((id(node), truth), (*other, *rest) if ends else other)
            facts = self._work.facts_of(untaken)
            lost = test.why if test.known is not UNKNOWN else (test.less_false if truth else test.less_true)
            if lost:
                self._note_skipped(untaken, inner, lost, surely=test.known is not UNKNOWN)
                if test.known is not UNKNOWN and not (self._work.facts_of(taken).acts(self._fields)):
                    inner.control |= lost
            inner.inputs |= shared_of(test.inputs)
            _assume(node.test, inner, truth=truth)
            before = inner.skipped
            after = self._block(taken, inner)
            wanted = facts.flags & self._fields.keys()
            for way, each in after.items():
                if (
                    lost
                    and not facts.drops
                    and wanted
                    and all(
                        each.values.get(flag, AbstractValue()).known is True
                        and each.values.get(flag) is not state.values.get(flag)
                        for flag in wanted
                    )
                ):
                    each.skipped = (each.skipped - lost) | (before - lost) | state.skipped
                if way.how == "next":
                    stays = not facts.leaves
                    each.control = control if stays else each.control
                    each.inputs = inputs if stays and not self._work.facts_of(taken).leaves else each.inputs
                _add(exits, way, each)
        return exits

    def _note_skipped(
        self, untaken: Sequence[nodes.Statement], state: PathState, lost: Places, *, surely: bool
    ) -> None:
        """Note what does not happen because of NaN: a drop, or an assignment."""
        facts = self._work.facts_of(untaken)
        assigns = self._source is None and not facts.flags.isdisjoint(self._fields)
        if self._suppresses_message(facts) or assigns:
            state.skipped |= lost
        elif surely and facts.drops:  # other messages; a test of NaN is a decision about it
            state.skipped |= {place for place in lost if place[0] != TEST}
        for name, assigned in facts.assigned:
            value = self._read(name, state)
            if isinstance(value.known, AbstractParts | tuple) or name in self._fields:
                continue
            constant = assigned.value if isinstance(assigned, nodes.Literal) else None
            if value.known is UNKNOWN and isinstance(constant, bool):
                if constant:
                    value = value._replace(less_true=value.less_true | lost)
                else:
                    value = value._replace(less_false=value.less_false | lost)
            else:
                value = value._replace(why=value.why | lost)
            state.values[name] = value
        for call in facts.puts:
            if (found := self._place(call.arguments[0], state)) is not None:
                whole = self._read(found[0], state) if found is not None else AbstractValue()
                if found is not None and isinstance(whole.known, AbstractParts):
                    index = self.value(call.arguments[1], state).known
                    path = (*found[1], index if isinstance(index, int) else ANY)
                    part = whole.known.parts.get(path)
                    if part is not None and part.is_nan:
                        part = part._replace(why=part.why | lost)
                        state.values[found[0]] = whole._replace(known=whole.known.with_part(path, part))

    def _suppresses_message(self, facts: BlockFacts) -> bool:
        return facts.drops and (None in facts.stops or self._topic in facts.stops)

    def _loop(self, state: PathState, body: Callable[[PathState], Exits], *, ends: bool) -> Exits:
        heads, exits = {state.fate: state}, Exits()
        for number in range(_ROUNDS):
            known = {fate: dict(head.values) for fate, head in heads.items()}
            exits = Exits()
            for fate, head in [*heads.items()]:
                if ends:
                    _add(exits, Exit("next", fate), head.branch())
                for way, after in body(head.branch()).items():
                    if way.how in ("next", "continue"):
                        _add(heads, way.fate, after)
                    else:
                        _add(exits, Exit("next", way.fate) if way.how == "break" else way, after)
            if all(known.get(fate) == head.values for fate, head in heads.items()):
                break
            if number >= _WIDENED:
                for fate, head in heads.items():
                    _widen(known.get(fate, {}), head)
        return exits

    def _require(self, node: nodes.Require, state: PathState) -> Exits:
        test = self.value(node.test, state)
        exits: Exits = {}
        if test.known is UNKNOWN or not test.known:
            out = state.branch()
            if self.restricts:
                out.skipped |= test.why if test.known is not UNKNOWN else test.less_true
            exits[Exit("leave", state.fate, happened=False)] = out
        if test.known is UNKNOWN or test.known:
            state.inputs |= shared_of(test.inputs)
            _assume(node.test, state, truth=True)
            exits[Exit("next", state.fate)] = state
        return exits

    # Expressions

    def value(self, node: nodes.Expression, state: PathState) -> AbstractValue:
        made: AbstractValue = _EXPRESSIONS.get(type(node), FlowAnalysis._unknown)(self, node, state)
        return made

    def _unknown(self, _node: Any, _state: PathState) -> AbstractValue:
        return AbstractValue()

    def _literal(self, node: nodes.Literal, _: PathState) -> AbstractValue:
        if isinstance(node.value, bytes):
            return AbstractValue(node.value) if node.type == value_types.STRING else AbstractValue()
        return AbstractValue() if node.value is None else of_number(node.value)

    def _read(self, name: str, state: PathState) -> AbstractValue:
        found = state.values.get(name)
        return unset(name) if found is None else found

    def _variable(self, node: nodes.Read, state: PathState) -> AbstractValue:
        return self._read(node.name, state)

    def _assign(self, node: nodes.Assign, state: PathState) -> AbstractValue:
        value = self.value(node.value, state)
        if node.name in self._fields and value.known is True:
            state.written |= {self._site}
        state.set(node.name, value)
        return value

    def _convert(self, node: nodes.Convert, state: PathState) -> AbstractValue:
        value = self.value(node.value, state)
        whole = not isinstance(node.type, value_types.FloatingType)
        if whole and isinstance(node.value.type, value_types.FloatingType):
            self.compared |= value.inputs
        if value.is_nan and whole:
            known = isinstance(node.type, value_types.BoolType)
            return value._replace(known=known or 0, why=value.why | {(CAST, self._site)}, may_be_nan=False)
        if isinstance(node.type, value_types.BoolType):
            known = bool(value.known) if value.is_number else value.known
            return value._replace(known=known, inputs=shared_of(value.inputs))
        if not value.is_number or value.is_nan:
            return value
        if not whole:
            return value._replace(known=float(value.known))
        return value._replace(known=int(value.known) if math.isfinite(value.known) else UNKNOWN)

    def _arithmetic(self, node: nodes.Arithmetic, state: PathState) -> AbstractValue:
        left, right = self.value(node.left, state), self.value(node.right, state)
        inputs = left.inputs | right.inputs
        if isinstance(node.type, value_types.FloatingType):
            if left.is_nan or right.is_nan:
                return AbstractValue(NAN, left.why | right.why, inputs=inputs)
            if node.operator == "/" and not (right.is_number and right.known):
                self.operations.add(node.site)
                if node.site == self._source:
                    return AbstractValue(NAN, inputs=inputs)
            elif left.is_number and right.is_number and node.operator in _CALCULATED:
                return of_number(
                    _CALCULATED[node.operator](left.known, right.known), left.why | right.why, inputs
                )
            return AbstractValue(may_be_nan=left.may_be_nan or right.may_be_nan, inputs=inputs)
        if left.is_number and right.is_number and node.operator in _CALCULATED:
            known = _CALCULATED[node.operator](left.known, right.known)
            if abs(known) < 1 << 31:  # it does not wrap
                return AbstractValue(known, left.why | right.why, inputs=inputs)
        return AbstractValue(inputs=inputs)

    def _unary(self, node: nodes.Unary, state: PathState) -> AbstractValue:
        value = self.value(node.value, state)
        if value.is_nan or value.known is UNKNOWN:
            return value
        if node.operator == "~" or not value.is_number:
            return AbstractValue(inputs=value.inputs)
        return value._replace(known=-value.known if node.operator == "-" else abs(value.known))

    def _compare(self, node: nodes.Compare, state: PathState) -> AbstractValue:
        left, right = self.value(node.left, state), self.value(node.right, state)
        inputs, place = left.inputs | right.inputs, frozenset({(COMPARISON, node.site)})
        if isinstance(node.left.type, value_types.FloatingType):
            self.compared |= inputs
        inputs = shared_of(inputs)
        if node.left == node.right and node.operator in ("==", "!="):
            place = frozenset({(TEST, node.site)})
        if left.is_nan or right.is_nan:
            tells = node.operator not in ("==", "!=") or node.left == node.right
            why = place | left.why | right.why if tells else EMPTY
            return AbstractValue(node.operator == "!=", why, inputs=inputs)
        match node:
            case nodes.Compare("<=", nodes.Read(name=name), nodes.Literal(value=int(least))) if (
                self._most.get(name, least + 1) <= least
            ):
                return AbstractValue(True, inputs=inputs)
        if left.is_number and right.is_number:
            why = of_compared(left) | of_compared(right)
            if node.operator in ("==", "!="):  # a bounded number is compared, such as 0
                why = frozenset(place for place in why if place[0] == COMPARISON)
            return AbstractValue(_COMPARED[node.operator](left.known, right.known), why, inputs=inputs)
        if (left.may_be_nan or right.may_be_nan) and node.operator not in ("==", "!="):
            return AbstractValue(less_true=place, inputs=inputs)
        return AbstractValue(inputs=inputs)

    def _texts(self, node: nodes.CompareTexts, state: PathState) -> AbstractValue:
        left, right = self.value(node.left, state), self.value(node.right, state)
        inputs, why = shared_of(left.inputs | right.inputs), left.why | right.why
        if isinstance(left.known, bytes) and isinstance(right.known, bytes):
            return AbstractValue(_COMPARED[node.operator](left.known, right.known), why, inputs=inputs)
        return AbstractValue(inputs=inputs)

    def _logical(self, node: nodes.Logical, state: PathState) -> AbstractValue:
        left = self.value(node.left, state)
        decisive = node.operator == "or"
        aside = state.branch()
        _assume(node.left, aside, truth=not decisive)
        right = self.value(node.right, aside)
        inputs = left.inputs | right.inputs
        deciding = [one for one in (left, right) if one.known is not UNKNOWN and bool(one.known) is decisive]
        if deciding:
            plain = any(not one.why for one in deciding)
            why = EMPTY if plain else frozenset().union(*(one.why for one in deciding))
            return AbstractValue(decisive, why, inputs=inputs)
        if left.known is not UNKNOWN and right.known is not UNKNOWN:
            return AbstractValue(not decisive, left.why | right.why, inputs=inputs)
        true, false = left.less_true | right.less_true, left.less_false | right.less_false
        neutral = frozenset().union(*(one.why for one in (left, right) if one.known is not UNKNOWN))
        true, false = (true | neutral, false) if decisive else (true, false | neutral)
        return AbstractValue(less_true=true, less_false=false, inputs=inputs)

    def _not(self, node: nodes.Not, state: PathState) -> AbstractValue:
        return negate(self.value(node.value, state))

    def _conditional(self, node: nodes.Conditional, state: PathState) -> AbstractValue:
        test = self.value(node.test, state)
        sides = []
        for truth, side in ((True, node.yes), (False, node.no)):
            aside = state.branch()
            _assume(node.test, aside, truth=truth)
            sides.append(self.value(side, aside))
        yes, no = sides
        inputs = shared_of(test.inputs) | yes.inputs | no.inputs
        if test.known is not UNKNOWN:
            taken, other, form = (yes, no, node.no) if test.known else (no, yes, node.yes)
            kept = taken.is_constant or other.is_constant or _bounds(form)
            why = taken.why | test.why if kept else taken.why
            return taken._replace(why=why, inputs=inputs)
        if isinstance(yes.known, bool) and isinstance(no.known, bool) and yes.known is not no.known:
            return (test if yes.known else negate(test))._replace(inputs=inputs)
        both = join(yes, no)
        if both.may_be_nan:
            both = both._replace(why=both.why | test.less_true | test.less_false)
        return both._replace(inputs=inputs)

    def _sequence(self, node: nodes.Sequence, state: PathState) -> AbstractValue:
        values = [self.value(item, state) for item in node.items]
        return values[node.chosen]

    def _log(self, _node: nodes.Log, state: PathState) -> AbstractValue:
        state.spoke = True
        return AbstractValue()

    def _discard(self, node: nodes.Discard, state: PathState) -> AbstractValue:
        return self.value(node.value, state)

    def _item(self, node: nodes.Item, state: PathState) -> AbstractValue:
        return self.value(node.base, state).part(node.number, node.type)

    def _vector(self, node: nodes.Vector, state: PathState) -> AbstractValue:
        values = [self.value(item, state) for item in node.items]
        box = AbstractParts({}, AbstractValue(0))
        for number, value in enumerate(values):
            box = box.with_part((number,), value)
        return AbstractValue(box, inputs=frozenset().union(*(value.inputs for value in values)))

    def _zero(self, node: nodes.Zero, _: PathState) -> AbstractValue:
        if isinstance(node.type, value_types.RecordType | value_types.VectorType):
            return AbstractValue(AbstractParts({}, AbstractValue(0)))
        return AbstractValue(False if isinstance(node.type, value_types.BoolType) else 0) if value_types.is_number(
            node.type) else AbstractValue()  # fmt: skip

    def _copy(self, node: nodes.Copy | nodes.Recast, state: PathState) -> AbstractValue:
        return self.value(node.value, state)

    def _whole(self, _node: nodes.Whole, _: PathState) -> AbstractValue:
        return AbstractValue(inputs=frozenset({"message"}))

    def _accumulate(self, node: nodes.Accumulate, state: PathState) -> AbstractValue:
        element = self.value(node.vector, state).part(ANY, node.type)
        start = self.value(node.start, state)
        known = NAN if element.is_nan or start.is_nan else UNKNOWN
        return AbstractValue(
            known, element.why | start.why if known is NAN else EMPTY, inputs=element.inputs | start.inputs
        )

    def _call(self, node: nodes.Call, state: PathState) -> AbstractValue:
        name, word = node.function, node.function.removeprefix("h_")
        if name in ("a_put", "a_slot", "l_append"):
            return self._put(node, state)
        arguments = [self.value(argument, state) for argument in node.arguments]
        inputs = frozenset[str]().union(*(argument.inputs for argument in arguments))
        if name == "l_element":
            index = arguments[1].known
            return arguments[0].part(index if isinstance(index, int) else ANY, node.type)
        if name == "l_nearest":
            self.compared |= inputs
            nan = arguments[0].part(ANY, value_types.DOUBLE).is_nan
            why = frozenset({("nearest", self._site)}) if nan else EMPTY
            return AbstractValue(math.inf if nan else UNKNOWN, why, inputs=inputs)
        if word != name and arguments and isinstance(node.arguments[0].type, value_types.FloatingType):
            return self._calculate(node, word, arguments, inputs)
        return AbstractValue(inputs=inputs)

    def _calculate(
        self, node: nodes.Call, word: str, arguments: Sequence[AbstractValue], inputs: frozenset[str]
    ) -> AbstractValue:
        """Return the result of a function of `<math.h>` of floating-point numbers."""
        plain, nan = word.removesuffix("f"), any(argument.is_nan for argument in arguments)
        if word in _TESTS:
            return self._test(word, arguments[0], shared_of(inputs))
        if plain in ("min", "max", "fmin", "fmax"):
            self.compared |= inputs
            return self._least(plain, self._site_of(node), arguments)
        if not isinstance(node.type, value_types.FloatingType):  # lround and others
            self.compared |= inputs
            return AbstractValue(
                0 if nan else UNKNOWN, frozenset({(CAST, self._site)} if nan else ()), inputs=inputs
            )
        if plain in _PARTIAL:
            self.operations.add(self._site)
            nan = nan or self._site == self._source
        if nan:
            return AbstractValue(NAN, why_of(one for one in arguments if one.is_nan), inputs=inputs)
        if plain == "fabs" and arguments[0].is_number:
            return arguments[0]._replace(known=abs(arguments[0].known))
        return AbstractValue(may_be_nan=any(argument.may_be_nan for argument in arguments), inputs=inputs)

    def _test(self, word: str, value: AbstractValue, inputs: frozenset[str]) -> AbstractValue:
        if value.is_nan:
            return AbstractValue(word == "isnan", value.why | {(TEST, self._site)}, inputs=inputs)
        if value.is_number:
            return AbstractValue(_TESTS[word](value.known), value.why, inputs=inputs)
        return AbstractValue(inputs=inputs)

    def _site_of(self, node: nodes.Call) -> int:
        return node.site if node.site >= 0 else self._site

    def _least(self, word: str, site: int, arguments: Sequence[AbstractValue]) -> AbstractValue:
        first, second = arguments
        inputs, place = first.inputs | second.inputs, frozenset({(word, site)})
        if first.is_nan or second.is_nan:
            taken = second if word.startswith("f") and first.is_nan else first
            return taken._replace(why=first.why | second.why | place, inputs=inputs)
        if first.is_number and second.is_number:
            choose = min if word.endswith("min") else max
            return AbstractValue(choose(first.known, second.known), first.why | second.why, inputs=inputs)
        nan = first.may_be_nan or second.may_be_nan
        return AbstractValue(
            UNKNOWN, first.why | second.why | (place if nan else EMPTY), may_be_nan=nan, inputs=inputs
        )

    def _put(self, node: nodes.Call, state: PathState) -> AbstractValue:
        base, *more = node.arguments
        value = self.value(more[-1] if node.function != "l_append" else more[0], state)
        index: int | str = ANY
        if node.function != "l_append":
            known = self.value(more[0], state).known
            index = known if isinstance(known, int) and not isinstance(known, bool) else ANY
        found = self._place(base, state)
        if found is None:
            return value
        name, path = found[0], (*found[1], index)
        before = self._read(name, state)
        box = before.known if isinstance(before.known, AbstractParts) else AbstractParts()
        if node.function == "l_append" and (old := box.parts.get(path)) is not None:
            value = join(old, value)
        if state.control and (value.is_number or value.known is UNKNOWN):
            value = value._replace(why=value.why | state.control)
        inputs = before.inputs | value.inputs | state.inputs
        state.values[name] = before._replace(known=box.with_part(path, value), inputs=inputs)
        return value

    def _place(self, form: nodes.Expression, state: PathState) -> tuple[str, Path] | None:
        """Return the variable of a message or vector, and the path of a part of it."""
        path: list[int | str] = []
        while not isinstance(form, nodes.Read):
            match form:
                case nodes.Item(base=inner, number=number):
                    path.insert(0, number)
                case nodes.Call(function="l_element", arguments=(inner, at)):
                    known = self.value(at, state).known
                    path.insert(0, known if isinstance(known, int) else ANY)
                case _:
                    return None
            form = inner
        return form.name, tuple(path)

    def _invoke(self, node: nodes.Invoke, state: PathState) -> AbstractValue:
        arguments = [self.value(argument, state) for argument in node.arguments]
        inputs = frozenset[str]().union(*(argument.inputs for argument in arguments))
        function = self._functions.get(node.function)
        if function is None or self._depth >= _DEPTH:
            return AbstractValue(inputs=inputs)
        if function.name.startswith(nodes.PURE):
            return self._library(function, arguments, inputs)
        return self._called(function, arguments, inputs, state)

    def _library(
        self, function: nodes.Function, arguments: Sequence[AbstractValue], inputs: frozenset[str]
    ) -> AbstractValue:
        """Return the result of a function of the library, whose own comparisons are not reported."""
        if function.same_as:  # `sin` and others, of numbers only
            nan = any(argument.is_nan for argument in arguments)
            return AbstractValue(NAN if nan else UNKNOWN, why_of(arguments) if nan else EMPTY, inputs=inputs)
        self.compared |= inputs
        if not any(map(is_tainted, arguments)):
            return AbstractValue(inputs=inputs)
        plain = tuple(argument._replace(inputs=EMPTY) for argument in arguments)
        aside = FlowAnalysis(self._functions, {}, None, work=self._work)
        aside._depth = self._depth
        found, why = aside._called(function, plain, EMPTY, PathState()), why_of(arguments)
        if found.is_number and not found.is_nan and found.why:
            return AbstractValue(found.known, frozenset({(CALL, self._site)}), inputs=inputs)
        true, false = (
            frozenset({(CALL, self._site)} if places else ())
            for places in (found.less_true, found.less_false)
        )
        return AbstractValue(
            found.known, why if found.is_nan else EMPTY, true, false, found.may_be_nan, inputs
        )

    def _called(
        self,
        function: nodes.Function,
        arguments: Sequence[AbstractValue],
        inputs: frozenset[str],
        state: PathState,
    ) -> AbstractValue:
        """Follow a call; a function without effects is followed once for each set of values that it reads."""
        facts = self._work.facts_of_function(function, self._functions)
        if not facts.pure:
            return self._follow(function, arguments, inputs, state)
        read = {name: state.values[name] for name in facts.shared if name in state.values}
        source = self._source if self._source in facts.sites else None
        key = (
            function.name, self._depth, source, state.control, state.inputs, *map(key_of, arguments),
            *((name, key_of(value)) for name, value in read.items()),
        )  # fmt: skip
        call = self._work.calls.get(key)
        if call is None:
            before = self.compared, self.operations
            self.compared, self.operations = set(), set()
            inner = PathState(read, control=state.control, inputs=state.inputs)
            result = self._follow(function, arguments, inputs, inner)
            call = PureCall(
                result, inner.skipped, inner.spoke, frozenset(self.compared), frozenset(self.operations)
            )
            self._work.calls[key] = call
            self.compared, self.operations = before
        self.compared |= call.compared
        self.operations |= call.operations
        state.skipped |= call.skipped
        state.spoke = state.spoke or call.spoke
        return call.result

    def _follow(
        self,
        function: nodes.Function,
        arguments: Sequence[AbstractValue],
        inputs: frozenset[str],
        state: PathState,
    ) -> AbstractValue:
        site = self._site
        inner = state.branch()
        for name, value in zip(function.parameters, arguments, strict=False):
            inner.values[name] = value
        self._depth += 1
        exits = self._block(function.body, inner)
        self._depth -= 1
        self._site = site
        if not exits:
            return AbstractValue(inputs=inputs)
        after = merge(exits.values())
        for name, value in after.values.items():
            state.values[name] = value
        state.skipped |= after.skipped
        state.spoke = state.spoke or after.spoke
        state.written |= after.written
        return after.result


_CALCULATED: Mapping[str, Callable[[Any, Any], Any]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul,
}  # fmt: skip
_COMPARED: Mapping[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq, "!=": operator.ne, "<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge,
}  # fmt: skip
_TESTS: Mapping[str, Callable[[float], bool]] = {
    "isnan": math.isnan, "isinf": math.isinf, "isfinite": math.isfinite,
}  # fmt: skip
_PARTIAL = frozenset({
    "sqrt", "log", "log2", "log10", "log1p", "asin", "acos", "acosh", "atanh", "fmod", "remainder", "pow",
})  # fmt: skip

_STATEMENTS: Mapping[type[Any], Callable[[FlowAnalysis, Any, PathState], Exits]] = {
    nodes.Evaluate: FlowAnalysis._evaluate,
    nodes.Loop: FlowAnalysis._endless,
    nodes.ForEach: FlowAnalysis._for_each,
    nodes.Break: FlowAnalysis._break,
    nodes.Continue: FlowAnalysis._continue,
    nodes.Select: FlowAnalysis._select,
    nodes.Return: FlowAnalysis._return,
    nodes.Leave: FlowAnalysis._leave,
    nodes.Drop: FlowAnalysis._drop,
    nodes.StopMessage: FlowAnalysis._stop,
    nodes.Publish: FlowAnalysis._publish,
    nodes.Require: FlowAnalysis._require,
    nodes.ReadNumbers: FlowAnalysis._read_numbers,
    nodes.ReadValue: FlowAnalysis._read_value,
    nodes.WriteBack: FlowAnalysis._write_back,
}
_EXPRESSIONS: Mapping[type[Any], Callable[[FlowAnalysis, Any, PathState], AbstractValue]] = {
    nodes.Literal: FlowAnalysis._literal,
    nodes.Read: FlowAnalysis._variable,
    nodes.Assign: FlowAnalysis._assign,
    nodes.Convert: FlowAnalysis._convert,
    nodes.Arithmetic: FlowAnalysis._arithmetic,
    nodes.Unary: FlowAnalysis._unary,
    nodes.Compare: FlowAnalysis._compare,
    nodes.CompareTexts: FlowAnalysis._texts,
    nodes.Logical: FlowAnalysis._logical,
    nodes.Not: FlowAnalysis._not,
    nodes.Log: FlowAnalysis._log,
    nodes.Conditional: FlowAnalysis._conditional,
    nodes.Sequence: FlowAnalysis._sequence,
    nodes.Discard: FlowAnalysis._discard,
    nodes.Item: FlowAnalysis._item,
    nodes.Vector: FlowAnalysis._vector,
    nodes.Zero: FlowAnalysis._zero,
    nodes.Copy: FlowAnalysis._copy,
    nodes.Recast: FlowAnalysis._copy,
    nodes.Whole: FlowAnalysis._whole,
    nodes.Accumulate: FlowAnalysis._accumulate,
    nodes.Call: FlowAnalysis._call,
    nodes.Invoke: FlowAnalysis._invoke,
}


def _assume(test: nodes.Expression, state: PathState, *, truth: bool) -> None:
    """Set the unknown truths of variables that a test decides."""
    match test:
        case nodes.Not(value=inner):
            _assume(inner, state, truth=not truth)
        case nodes.Logical(operator=word, left=left, right=right) if truth is (word == "and"):
            _assume(left, state, truth=truth)
            _assume(right, state, truth=truth)
        case nodes.Compare(operator="<" | "<=" | ">" | ">=", left=left, right=right) if truth:
            for side in (left, right):
                known = state.values.get(side.name) if isinstance(side, nodes.Read) else None
                if isinstance(side, nodes.Read) and known is not None and known.may_be_nan:
                    state.values[side.name] = known._replace(may_be_nan=False)  # the comparison is true
        case nodes.Read(type=value_types.BoolType(), name=name):
            known = state.values.get(name) or unset(name)
            if known.known is UNKNOWN:
                state.values[name] = known._replace(known=truth, less_true=EMPTY, less_false=EMPTY)


def _widen(known: Mapping[str, AbstractValue], head: PathState) -> None:
    for name, value in head.values.items():
        if known.get(name) != value and not isinstance(value.known, tuple):
            head.values[name] = value._replace(known=UNKNOWN, may_be_nan=value.may_be_nan or value.is_nan)


def _bounds(form: nodes.Expression) -> bool:
    """Whether a value is bounded: by `min` and the like, or by a function of the library."""
    return any(
        (
            isinstance(node, nodes.Call)
            and node.function.removeprefix("h_").removesuffix("f") in ("min", "max", "fmin", "fmax")
        )
        or (isinstance(node, nodes.Invoke) and node.function.startswith(nodes.PURE))
        for node in nodes.walk(form)
    )


_Key = TypeVar("_Key")


def _add(states: dict[_Key, PathState], key: _Key, state: PathState) -> None:
    known = states.get(key)
    states[key] = state if known is None else merge((known, state))
