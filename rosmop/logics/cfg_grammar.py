"""Read the context-free grammars of ``cfg`` properties, and transform them for parsing.

A symbol is a number: an event has its index, a nonterminal a number from ``terminals`` on.
"""

from dataclasses import dataclass

from rosmop.logics.formula import MAX_NESTING
from rosmop.logics.interface import Source
from rosmop.logics.lexer import FormulaToken, TokenReader, describe, suggestion

MAX_SYMBOLS = 20_000

Rule = tuple[int, tuple[int, ...]]


@dataclass(frozen=True)
class Grammar:
    """Rules without duplicates; ``start`` is None if the language is empty."""

    terminals: int
    start: int | None
    rules: tuple[Rule, ...]


def read_grammar(source: Source) -> Grammar:
    return _GrammarReader(source).grammar()


class _GrammarReader:
    def __init__(self, source: Source) -> None:
        self._tokens = TokenReader(source, ("->", "|", ",", "*", "+", "(", ")", ";", "::=", ":"))
        self._source = source
        self._rules: dict[Rule, None] = {}
        self._heads: dict[str, int] = {}
        self._count = len(source.events)
        self._size = 0

    def grammar(self) -> Grammar:
        self._find_heads()
        if not self._heads and self._tokens.ahead(1).kind not in (":", "::="):
            raise self._tokens.unexpected("a production such as `S -> a S b | epsilon`")
        while self._tokens.token.kind != "end":
            self._production()
        self._tokens.finish()
        return Grammar(len(self._source.events), next(iter(self._heads.values())), tuple(self._rules))

    def _find_heads(self) -> None:
        for index in range(len(self._source.text)):
            token, following = self._tokens.ahead(index), self._tokens.ahead(index + 1)
            if token.kind == "end":
                return
            if token.kind == "name" and following.kind == "->" and token.text not in self._heads:
                if token.text in self._source.events:
                    self._tokens.note(
                        token, f"`{token.text}` is an event and cannot be a left side; rename one of them"
                    )
                self._heads[token.text] = self._fresh()

    def _fresh(self) -> int:
        self._count += 1
        return self._count - 1

    def _production(self) -> None:
        head = self._tokens.expect("name", "the left side of a production")
        if self._tokens.token.kind in (":", "::="):
            raise self._source.error(
                self._tokens.token.offset, "write `->` between the two sides of a production"
            )
        self._tokens.expect("->", f"`->` after `{head.text}`")
        self._alternatives(self._heads[head.text], 0)
        if (
            not self._tokens.accept(",")
            and not self._tokens.accept(";")
            and self._tokens.token.kind == "name"
        ):
            return
        if self._tokens.token.kind not in ("name", "end"):
            raise self._tokens.unexpected("an event, a nonterminal, `|`, `,` or the end of the grammar")

    def _alternatives(self, head: int, depth: int) -> None:
        while True:
            self._add(head, self._alternative(depth))
            if not self._tokens.accept("|"):
                return

    def _add(self, head: int, symbols: list[int]) -> None:
        self._size += 1 + len(symbols)
        if self._size > MAX_SYMBOLS:
            raise self._source.error(0, f"a grammar of more than {MAX_SYMBOLS} symbols")
        self._rules[head, tuple(symbols)] = None

    def _alternative(self, depth: int) -> list[int]:
        symbols: list[int] = []
        began = self._tokens.token
        some = False
        while self._at_symbol():
            some = True
            symbols += self._symbol(depth)
        if not some:
            raise self._source.error(began.offset, f"expected a symbol or `epsilon`, found {describe(began)}")
        return symbols

    def _at_symbol(self) -> bool:
        token = self._tokens.token
        return token.kind == "(" or (
            token.kind == "name" and self._tokens.ahead(1).kind not in ("->", "::=", ":")
        )

    def _symbol(self, depth: int) -> list[int]:
        token = self._tokens.take()
        if token.kind == "(":
            if depth >= MAX_NESTING:
                raise self._source.error(token.offset, f"nested more than {MAX_NESTING} deep")
            group = self._fresh()
            self._alternatives(group, depth + 1)
            self._tokens.expect(")", "`)` or a symbol")
            symbols = [group]
        elif token.text == "epsilon":
            symbols = []
        else:
            symbols = [self._number(token)]
        while self._tokens.token.kind in ("*", "+"):
            sign = self._tokens.take()
            many = self._fresh()
            self._add(many, [many, *symbols])
            self._add(many, symbols if sign.kind == "+" else [])
            symbols = [many]
        return symbols

    def _number(self, token: FormulaToken) -> int:
        if token.text in self._heads:
            return self._heads[token.text]
        if token.text not in self._source.events:
            known = [*self._heads, *self._source.events]
            self._tokens.note(
                token, f"`{token.text}` is neither an event nor a left side{suggestion(token.text, known)}"
            )
            return 0
        return self._source.events.index(token.text)


def prepare(grammar: Grammar) -> Grammar:
    """Keep only useful symbols, each of which derives more than the empty word.

    ``A -> A x A`` becomes ``A -> A x B``, where ``B`` has the other rules of ``A``, because only the second
    form is unambiguous. The start symbol may still derive the empty word; if it derives nothing else, no rule
    remains.
    """
    rules = _flat_repetitions(grammar)
    productive = _closure(rules, grammar.terminals)
    rules = [
        rule
        for rule in rules
        if all(symbol < grammar.terminals or symbol in productive for symbol in rule[1])
    ]
    if grammar.start not in productive:
        return Grammar(grammar.terminals, None, ())
    substantial = _substantial(rules, grammar.terminals)
    slim = {
        (head, tuple(symbol for symbol in body if symbol < grammar.terminals or symbol in substantial)): None
        for head, body in rules
        if head in substantial or head == grammar.start
    }
    useful = _reachable(grammar.start, list(slim))
    return Grammar(
        grammar.terminals,
        grammar.start,
        tuple((head, body) for head, body in slim if head in useful and body != (head,)),
    )


def _flat_repetitions(grammar: Grammar) -> list[Rule]:
    count = 1 + max([grammar.terminals, *(max((head, *body)) for head, body in grammar.rules)])
    by_head: dict[int, list[tuple[int, ...]]] = {}
    for head, body in grammar.rules:
        by_head.setdefault(head, []).append(body)
    rules: list[Rule] = []
    for head, bodies in by_head.items():
        doubled = [body for body in bodies if len(body) > 1 and body[0] == body[-1] == head]
        if not doubled:
            rules += [(head, body) for body in bodies]
            continue
        single, count = count, count + 1
        rules += [(single, body) for body in bodies if body not in doubled]
        rules += [(head, (single,)), *((head, (*body[:-1], single)) for body in doubled)]
    return rules


def _closure(rules: list[Rule], terminals: int) -> set[int]:
    found: set[int] = set()
    users: dict[int, list[int]] = {}
    missing = []
    waiting = []
    for number, (head, body) in enumerate(rules):
        needed = {symbol for symbol in body if symbol >= terminals}
        missing.append(len(needed))
        for symbol in needed:
            users.setdefault(symbol, []).append(number)
        if not needed:
            waiting.append(head)
    while waiting:
        symbol = waiting.pop()
        if symbol in found:
            continue
        found.add(symbol)
        for number in users.get(symbol, ()):
            missing[number] -= 1
            if not missing[number]:
                waiting.append(rules[number][0])
    return found


def _substantial(rules: list[Rule], terminals: int) -> set[int]:
    users: dict[int, list[int]] = {}
    waiting = []
    for head, body in rules:
        for symbol in body:
            if symbol < terminals:
                waiting.append(head)
            else:
                users.setdefault(symbol, []).append(head)
    found: set[int] = set()
    while waiting:
        symbol = waiting.pop()
        if symbol not in found:
            found.add(symbol)
            waiting += users.get(symbol, ())
    return found


def _reachable(start: int, rules: list[Rule]) -> set[int]:
    bodies: dict[int, list[tuple[int, ...]]] = {}
    for head, body in rules:
        bodies.setdefault(head, []).append(body)
    found: set[int] = set()
    waiting = [start]
    while waiting:
        symbol = waiting.pop()
        if symbol not in found:
            found.add(symbol)
            for body in bodies.get(symbol, ()):
                waiting += body
    return found


def nullable_symbols(grammar: Grammar) -> frozenset[int]:
    rules = [rule for rule in grammar.rules if all(symbol >= grammar.terminals for symbol in rule[1])]
    return frozenset(_closure(rules, grammar.terminals))
