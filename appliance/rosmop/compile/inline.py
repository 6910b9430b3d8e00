"""One event's code as a part of a loop over messages: what `compile/batch.py` puts together for a topic.

The function of an event (`compile/events.py`) is taken apart again and written anew: `return` becomes the drop of
this message or the way to the next event, a field is written where it stands, a step of a property is looked up. Only
harmless code (`compile/harmless.py`) is taken over; in the place of all other stands `break`, which gives this message
to the engine.

An event does nothing that cannot be taken back before its last line is certain: what the fields will be, the next
states of the properties, and only then (`_commit`) both.

Names of the loop: `view`, `position` and `following` (the frame), `b` (the message, where it is looked at alone),
`run` and `pieces` (what goes on), `loud` (changes are told in full) and `k_N` (drops of event N are), `n_N` and `x_N`
(how often event N happened, dropped), `y_0` (how often the only event changed something); of several events `undo`, and
`who` has changed this message (bit N for event N).
"""

import ast
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest

from appliance.rosmop.compile.harmless import Harmless, stored
from appliance.rosmop.compile.module import Module
from appliance.rosmop.compile.patches import Line, Patch, comparable, foreseen, written
from appliance.rosmop.compile.shapes import NoShapeError, Reader, Shape, Spot

MAX_DEPTH = 60
"""How deep a loop may be indented; Python takes no more than 100."""


class NotInlineError(Exception):
    """This event has no form as a part of a loop."""


@dataclass(frozen=True)
class Column:
    """What a step of a property is: from its state to the next one, -1 where a handler runs."""

    variable: str
    table: tuple[int, ...]


@dataclass(frozen=True)
class EventSource:
    """An event on the topic: its number there, and the source of its function.

    `guard` is the name that says whether its monitor is enabled, if there are others whose events happen.
    """

    number: int
    source: str
    columns: tuple[Column, ...]
    guard: str | None


@dataclass
class Body:
    """The lines of the loop's body, what they need, and what they do.

    `shape` is what equal frames have in common; None where every message is looked at for itself. With `several`
    events, what the first did must be taken back if another gives up.
    """

    module: Module
    shape: Shape | None
    several: bool
    lines: list[str] = field(default_factory=list)
    shared: set[str] = field(default_factory=set)
    patches: int = 0
    writers: set[int] = field(default_factory=set)
    droppers: set[int] = field(default_factory=set)
    always: bool = False
    """The one event happens with every message; it need not be counted."""

    def add(self, depth: int, *lines: str) -> None:
        """Append lines, so deep."""
        if depth > MAX_DEPTH:
            raise NotInlineError
        self.lines += ["    " * depth + line for line in lines]

    def add_all(self, depth: int, lines: Sequence[Line]) -> None:
        """Append lines of different depths."""
        for deeper, line in lines:
            self.add(depth + deeper, line)


class Inliner:
    """Writes one event."""

    def __init__(self, body: Body, harmless: Harmless, event: EventSource) -> None:
        self._body = body
        self._harmless = harmless
        self._event = event
        self._structs = body.module.structs
        self._reader = Reader(body.shape or Shape(), self._structs)
        self._globals: set[str] = set()
        self._names: dict[str, str] = {}
        self._patches: list[Patch] = []
        self._marks_drops = False
        self._base = 0

    def write(self, depth: int) -> None:
        """Write the event at this depth. Raises `NotInlineError`."""
        function = ast.parse(self._event.source).body[0]
        assert isinstance(function, ast.FunctionDef)  # it is the function of an event
        statements = list(function.body)
        if isinstance(statements[0], ast.Global):
            self._globals = set(statements[0].names)
            del statements[0]
        if self._event.guard is not None:
            self._body.add(depth, f"if {self._event.guard}:")
            depth += 1
        self._base = depth
        alike = self._body.shape is not None and not self._body.several
        self._body.always = alike and all(_refusal(node) is None for node in statements)
        if any(_marks_drop(node) for node in ast.walk(function)):
            self._marks_drops = True
            self._body.add(depth, f"{self._dropped} = False")
        statements = self._without_copies(statements)
        try:
            goes_on = self._block(statements, depth, finds=True)
        except NoShapeError:
            raise NotInlineError from None
        if not goes_on:
            raise NotInlineError

    @property
    def _dropped(self) -> str:
        return f"d_{self._event.number}"

    # Statements

    def _block(self, statements: Sequence[ast.stmt], depth: int, *, finds: bool = False) -> bool:
        """Write statements; whether any message can come past them. `finds`: those that find fields are there."""
        before = len(self._body.lines)
        for node, following in zip_longest(statements, statements[1:]):
            if finds and self._finds(node):
                continue
            refusal = _refusal(node)
            if refusal is not None:
                if not self._condition(_negated(refusal), depth):
                    return self._give_up(depth)
                depth += 1
            elif _is_drop(node):
                if isinstance(following, ast.Return):
                    self._drop(depth)
                    return True
                self._body.add(depth, f"{self._dropped} = True")
            elif isinstance(node, ast.Return):
                return self._commit(depth)
            elif not self._statement(node, depth):
                return self._give_up(depth)
        if len(self._body.lines) == before:
            self._body.add(depth, "pass")
        return True

    def _give_up(self, depth: int) -> bool:
        """This message is the engine's; whether others can come past this place."""
        self._body.add(depth, "break")
        return depth > self._base

    def _finds(self, node: ast.stmt) -> bool:
        """Whether the loop itself does what this statement does: find and read fields."""
        if ast.unparse(node) == "b = m.buffer":
            return True
        alone = self._body.shape is None
        try:
            given = self._reader.follow(node)
            if given is None:
                return self._reader.moves(node) and not alone
        except NoShapeError:
            if alone:
                self._reader.hide(node)
                return False
            raise
        if alone:
            return False
        self._names |= dict(given)
        return True

    def _statement(self, node: ast.stmt, depth: int) -> bool:
        """Write a statement; False if it is not harmless."""
        if isinstance(node, ast.If):
            if ast.unparse(node.test) == "m.dropped":
                if self._marks_drops:
                    self._body.add(depth, f"if {self._dropped}:")
                    self._drop(depth + 1)
                return True
            return self._write_field(node, depth) or self._if(node, depth)
        if not self._harmless.assignment(node):
            return isinstance(node, ast.Pass)
        self._body.shared |= stored([node]) & self._globals
        self._body.add(depth, self._text(node))
        return True

    def _condition(self, test: ast.expr, depth: int) -> bool:
        if not self._harmless.expression(test):
            return False
        self._body.shared |= stored([ast.Expr(test)]) & self._globals
        self._body.add(depth, f"if {self._text(test)}:")
        return True

    def _if(self, node: ast.If, depth: int) -> bool:
        if not self._condition(node.test, depth):
            return False
        self._block(node.body, depth + 1)
        if node.orelse:
            self._body.add(depth, "else:")
            self._block(node.orelse, depth + 1)
        return True

    def _drop(self, depth: int) -> None:
        """This message goes no further."""
        event = self._event.number
        self._body.droppers.add(event)
        self._body.add(
            depth,
            f"if k_{event}: break",
            *([] if self._body.always else [f"n_{event} += 1"]),
            f"x_{event} += 1",
            "if position > run: pieces.append(view[run:position])",
            "run = following" if self._body.shape is None else "run = position + stride",
            "continue",
        )

    # What is written, and what the properties do

    def _write_field(self, node: ast.If, depth: int) -> bool:
        """`if flag: m.patch(at, pack(value))`, if it is that."""
        call = node.body[0].value if isinstance(node.body[0], ast.Expr) else None
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute):
            return False
        packing = call.args[-1]
        if call.func.attr != "patch" or not isinstance(packing, ast.Call) or packing.keywords:
            return False
        if not isinstance(packing.func, ast.Name) or not self._harmless.expression(packing):
            return False
        code = self._structs[packing.func.id][0].removeprefix("<")
        spot = self._spot(call.args[0])
        before = self._before(spot, code)
        if before is None and self._body.several and self._body.shape is not None:
            raise NoShapeError  # later events would not see the new value
        self._body.patches += 1
        self._body.writers.add(self._event.number)
        patch = Patch(
            self._body.patches,
            self._text(node.test),
            code,
            self._text(packing.args[0]),
            self._text(packing),
            before,
            *self._place(spot, self._text(call.args[0])),
        )
        self._body.add_all(depth, foreseen(patch, self._body.module))
        self._patches.append(patch)
        return True

    def _spot(self, node: ast.expr) -> Spot | None:
        try:
            return self._reader.spot(node)
        except NoShapeError:
            if self._body.shape is None:
                return None
            raise

    def _before(self, spot: Spot | None, code: str) -> str | None:
        own = self._reader.names.get((spot, code)) if spot is not None and comparable(code) else None
        return None if own is None else self._name(own)

    def _place(self, spot: Spot | None, at: str) -> tuple[str, str]:
        """The buffer that the field is in, and where."""
        if self._body.shape is None or spot is None:
            return "b", at
        return "view", f"position + o_{self._body.shape.place(spot)}"

    def _commit(self, depth: int) -> bool:
        """The event has happened: properties step, fields are written, it is counted."""
        body, number = self._body, self._event.number
        steps = []
        for column in self._event.columns:
            if all(target < 0 for target in column.table):
                return self._give_up(depth)
            if any(target != state for state, target in enumerate(column.table)):
                table, target = body.module.use(column.table, "a"), f"t_{column.variable}"
                body.add(depth, f"{target} = {table}[{column.variable}]")
                if min(column.table) < 0:
                    body.add(depth, f"if {target} < 0: break")
                steps.append(f"{column.variable} = {target}")
        again = body.several and body.shape is not None
        writer = number if body.several else None
        for patch in self._patches:
            body.add_all(depth, written(patch, body.module, writer=writer, read_again=again))
        if len(self._patches) == 1 and not body.several:
            body.add(depth + 1, f"y_{number} += 1")
        elif self._patches and not body.several:
            differs = " or ".join(patch.differs for patch in self._patches)
            body.add(depth, f"if {differs}: y_{number} += 1")
        body.add(depth, *steps)
        if not body.always:
            body.add(depth, f"n_{number} += 1")
        return True

    # Names

    def _without_copies(self, statements: Sequence[ast.stmt]) -> list[ast.stmt]:
        """A parameter that only ever has the value of its field needs no variable of its own."""
        given: dict[str, int] = {}
        for name in (part for node in statements for part in ast.walk(node) if isinstance(part, ast.Name)):
            given[name.id] = given.get(name.id, 0) + isinstance(name.ctx, ast.Store)
        left = []
        for node in statements:
            names = _copied(node)
            if names and not self._globals & set(names) and all(given[name] == 1 for name in names):
                self._names[names[0]] = names[1]
            else:
                left.append(node)
        return left

    def _name(self, name: str) -> str:
        name = self._names.get(name, name)
        return self._names.get(name, name)

    def _text(self, node: ast.AST) -> str:
        copy = ast.parse(ast.unparse(node))
        if self._body.shape is not None and any(
            isinstance(part, ast.Name) and part.id == "b" for part in ast.walk(copy)
        ):
            raise NoShapeError
        return ast.unparse(_Renaming(self._name).visit(copy))


class _Renaming(ast.NodeTransformer):
    def __init__(self, rename: Callable[[str], str]) -> None:
        self._rename = rename

    def visit_Name(self, node: ast.Name) -> ast.Name:
        """Another name."""
        return ast.Name(self._rename(node.id), node.ctx)


def _copied(node: ast.stmt) -> tuple[str, ...]:
    """The names of `target = source`; empty if it is something else."""
    if isinstance(node, ast.Assign) and isinstance(node.value, ast.Name):
        target = node.targets[0]
        if isinstance(target, ast.Name):
            return target.id, node.value.id
    return ()


def _refusal(node: ast.stmt) -> ast.expr | None:
    """The condition of `if …: return False`: the event does not happen."""
    if not isinstance(node, ast.If) or len(node.body) != 1 or node.orelse:
        return None
    return node.test if ast.unparse(node.body[0]) == "return False" else None


def _negated(node: ast.expr) -> ast.expr:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return node.operand
    return ast.UnaryOp(ast.Not(), node)


def _is_drop(node: ast.stmt) -> bool:
    return ast.unparse(node) == "m.dropped = True" if isinstance(node, ast.Assign) else False


def _marks_drop(node: ast.AST) -> bool:
    """Whether a block has `DROP;`, after which the rest of it still runs."""
    bodies = [getattr(node, name, []) for name in ("body", "orelse")]
    return any(
        _is_drop(one) and not isinstance(following, ast.Return)
        for body in bodies
        if isinstance(body, list)
        for one, following in zip_longest(body, body[1:])
    )
