"""Follow state machines as written: `state [ event -> state, default state, timeout 2s -> state ]`."""

from collections.abc import Sequence

from rosmop.certify.formula_reader import UnsupportedFormulaError, WordReader

FAIL = "fail"


class StateMachineFollower:
    def __init__(self, formula: str, events: Sequence[str]) -> None:
        self._moves: dict[str, dict[str, str]] = {}
        self._default: dict[str, str] = {}
        self._aliases: dict[str, list[str]] = {}
        self._timeouts: dict[str, tuple[int, str]] = {}
        self._events = events
        words = WordReader(formula, ("->", "[", "]", "=", ","))
        while words.word:
            name = words.take()
            if words.accept("["):
                self._read_state(words, name)
            elif name == "alias":
                name = words.take()
                words.expect("=")
                self._aliases[name] = self._read_members(words)
            else:
                raise UnsupportedFormulaError(f"{name!r} does not begin a state")
        self.initial = next(iter(self._moves), FAIL)

    def _read_state(self, words: WordReader, state: str) -> None:
        if state in self._moves:
            raise UnsupportedFormulaError(f"the state {state!r} is defined twice")
        moves = self._moves.setdefault(state, {})
        while not words.accept("]"):
            event = words.take()
            if event == "timeout" and words.word[:1].isdecimal() | (words.word[:1] == "."):
                after = words.duration()
                words.expect("->")
                self._timeouts[state] = after, words.take()
                words.accept(",")
                continue
            arrow = words.accept("->")
            target = words.take()
            if event == "default":
                self._default[state] = target
            elif arrow and event in self._events:
                moves[event] = target
            else:
                raise UnsupportedFormulaError(f"{event!r} is not an event")
            words.accept(",")

    def _read_members(self, words: WordReader) -> list[str]:
        members = [words.take()]
        while words.accept(",") or (words.word and words.word != "alias"):
            members.append(words.take())
        return members

    def step(self, state: str, event: str) -> str:
        return self._moves.get(state, {}).get(event, self._default.get(state, FAIL))

    def timeout(self, state: str) -> tuple[int, str] | None:
        return self._timeouts.get(state)

    def verdicts(self, state: str) -> tuple[str, ...]:
        return (state, *(alias for alias, members in self._aliases.items() if state in members))
