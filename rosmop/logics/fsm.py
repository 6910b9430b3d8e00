"""``fsm``: finite state machines, as MOP's FSM plugin reads them; ``read_state_machine`` also reads ``tfsm``."""

from dataclasses import dataclass, field

from rosmop.logics.automaton import MAX_STATES, Automaton
from rosmop.logics.interface import FiniteProperty, Source
from rosmop.logics.lexer import FormulaToken, TokenReader, describe, suggestion

FAIL = "fail"
TIMEOUT = "timeout"


@dataclass
class StateText:
    """A state as written. Only a tfsm has timeouts."""

    moves: dict[str, FormulaToken] = field(default_factory=dict)
    default: FormulaToken | None = None
    timeout: tuple[int, FormulaToken] | None = None


@dataclass
class StateMachineText:
    """A state machine as written."""

    states: dict[str, StateText]
    aliases: dict[str, list[str]]

    @property
    def order(self) -> list[str]:
        return [*self.states, FAIL]

    def verdict(self, state: str) -> tuple[str, ...]:
        return (state, *(alias for alias, members in self.aliases.items() if state in members))

    def categories(self) -> list[str]:
        return [*self.states, *self.aliases, FAIL]


def compile_fsm(source: Source) -> FiniteProperty:
    machine = read_state_machine(source, timed=False)
    return FiniteProperty(source, machine.categories(), machine_automaton(source, machine))


def machine_automaton(source: Source, machine: StateMachineText) -> Automaton:
    order = machine.order
    number = {name: index for index, name in enumerate(order)}
    fail = number[FAIL]
    table = []
    for state in machine.states.values():
        default = fail if state.default is None else number[state.default.text]
        moves = {event: number[target.text] for event, target in state.moves.items()}
        table.append(tuple(moves.get(event, default) for event in source.events))
    table.append((fail,) * len(source.events))
    return Automaton(0, tuple(table), tuple(machine.verdict(name) for name in order), tuple(order))


def read_state_machine(source: Source, *, timed: bool) -> StateMachineText:
    reader = TokenReader(source, ("->", "[", "]", "=", ","))
    machine = StateMachineText({}, {})
    used: list[FormulaToken] = []
    if reader.token.kind == "end":
        raise reader.unexpected("a state such as `s0 [ event -> s1, default s0 ]`")
    while reader.token.kind != "end":
        if reader.token.text == "alias" and reader.ahead(1).kind != "[":
            _read_alias(reader, machine, used)
        else:
            _read_state(reader, machine, used, timed=timed)
    _check_names(reader, machine, used)
    reader.finish()
    return machine


def _read_state(
    reader: TokenReader, machine: StateMachineText, used: list[FormulaToken], *, timed: bool
) -> None:
    name = reader.expect("name", "the name of a state")
    reserved = (FAIL, TIMEOUT) if timed else (FAIL,)
    if name.text in reserved:
        reader.note(name, f"`{name.text}` is already a category and cannot name a state; choose another name")
    if name.text in machine.states:
        reader.note(name, f"state `{name.text}` is defined twice; put all its transitions into one `[ … ]`")
    if machine.aliases:
        reader.note(name, f"state `{name.text}` is written after an alias; write the states first")
    if len(machine.states) >= MAX_STATES:
        raise reader.source.error(name.offset, f"more than {MAX_STATES} states")
    state = machine.states.setdefault(name.text, StateText())
    reader.expect("[", f"`[` and the transitions of state `{name.text}`")
    while not reader.accept("]"):
        _read_transition(reader, state, used, timed=timed)
        reader.accept(",")


def _read_transition(reader: TokenReader, state: StateText, used: list[FormulaToken], *, timed: bool) -> None:
    event = reader.expect("name", "a transition such as `event -> state`, `default state` or `]`")
    if event.text == TIMEOUT and (reader.token.kind == "number" or reader.token.text in reader.source.times):
        if not timed:
            raise reader.source.error(
                event.offset, "a time bound in an untimed machine; write `tfsm:` for `fsm:`"
            )
        _read_timeout(reader, state, event, used)
        return
    if event.text == "default":
        reader.accept("->")
        target = reader.expect("name", "the state that `default` leads to")
        if state.default is not None:
            reader.note(event, "a second `default` in one state; keep one")
        state.default = target
    else:
        reader.check_event(event)
        reader.expect("->", f"`->` and the state that `{event.text}` leads to")
        target = reader.expect("name", f"the state that `{event.text}` leads to")
        if event.text in state.moves:
            reader.note(event, f"a second transition for `{event.text}` in one state; keep one")
        state.moves[event.text] = target
    used.append(target)


def _read_timeout(
    reader: TokenReader, state: StateText, clause: FormulaToken, used: list[FormulaToken]
) -> None:
    number = reader.token
    times = reader.source.times
    nanoseconds = times[reader.take().text] if number.text in times else reader.duration("a time bound")
    if nanoseconds == 0:
        reader.note(number, "a timeout must be longer than 0")
    reader.expect("->", "`->` and the state that the timeout leads to")
    target = reader.expect("name", "the state that the timeout leads to")
    if state.timeout is not None:
        reader.note(clause, "a second `timeout` in one state; keep one")
    state.timeout = (nanoseconds, target)
    used.append(target)


def _read_alias(reader: TokenReader, machine: StateMachineText, used: list[FormulaToken]) -> None:
    reader.take()
    name = reader.expect("name", "the name of an alias")
    if name.text in machine.states or name.text in (FAIL, TIMEOUT):
        reader.note(name, f"alias `{name.text}` has the name of an existing category; choose another name")
    if name.text in machine.aliases:
        reader.note(name, f"alias `{name.text}` is defined twice; put all its states into one list")
    reader.expect("=", "`=` and the states of the alias")
    members = machine.aliases.setdefault(name.text, [])
    while True:
        member = reader.expect("name", "the name of a state")
        members.append(member.text)
        used.append(member)
        if not reader.accept(",") and not _more_members(reader):
            return


def _more_members(reader: TokenReader) -> bool:
    return reader.token.kind == "name" and reader.token.text != "alias" and reader.ahead(1).kind != "["


def _check_names(reader: TokenReader, machine: StateMachineText, used: list[FormulaToken]) -> None:
    known = [*machine.states, FAIL]
    for token in used:
        if token.text not in machine.states and token.text != FAIL:
            reader.note(token, f"unknown state {describe(token)}{suggestion(token.text, known)}")
