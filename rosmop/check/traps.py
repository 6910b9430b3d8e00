"""Warn of valid code that passes an unsafe message, or stops a safe one, against its author's likely intention."""

from collections.abc import Iterator, Sequence
from ipaddress import ip_address
from itertools import combinations

from rosmop.check.phases import Phases
from rosmop.form.findings import Diagnostic
from rosmop.text import tree
from rosmop.types.messages import shown

_FLOATING = frozenset({("double",), ("float",)})
_MIN_MAX = frozenset({("std", "min"), ("std", "max"), ("min",), ("max",)})
_ABSOLUTE = frozenset({"abs", "fabs", "fabsf"})
_TESTS_OF_NAN = frozenset({"isnan", "isfinite", "isinf"})
_UNORDERED = frozenset({"<", "<=", ">", ">="})


def traps(specification: tree.Specification) -> Iterator[Diagnostic]:
    yield from _unlike_a_sender(specification)
    tests = {node.parts[-1] for node in tree.walk(specification) if isinstance(node, tree.Name)}
    for event in specification.events:
        if isinstance(event.trigger, tree.TimerTrigger) and not event.trigger.has_unit:
            period = f"{event.trigger.period_ns / 1e9:g}"
            text = f"`every` without a unit is {period} s; write `{period}s` or `{period}ms`"
            yield Diagnostic(event.trigger.position, "warning", text)
        yield from _called_again(event)
        yield from _always_dropped(event)
        yield from _lost_changes(event)
        if not tests & _TESTS_OF_NAN:
            yield from _passed_nan(event)


def _called_again(event: tree.EventDefinition) -> Iterator[Diagnostic]:
    match event.trigger:
        case tree.MessageTrigger(part="request" | "response", topic=service):
            for node in tree.walk(event.action):
                if isinstance(node, tree.CallStatement) and node.service == service:
                    text = f"calls {service}, and happens with each call of it: it calls without end;"
                    text = f"{shown(event.name)} {text} call it from another event"
                    yield Diagnostic(node.position, "warning", text)


def _unlike_a_sender(specification: tree.Specification) -> Iterator[Diagnostic]:
    own = {function.name for function in specification.functions}
    for node in tree.walk(specification):
        match node:
            case (
                tree.BinaryExpression(operator="==" | "!=", left=call, right=tree.StringLiteral() as text)
                | tree.BinaryExpression(operator="==" | "!=", left=tree.StringLiteral() as text, right=call)
            ) if isinstance(call, tree.CallExpression) and isinstance(call.callee, tree.Name):
                if call.callee.parts[-1] not in own and (
                    wrong := _wrong_sender(call.callee.parts[-1], text.value.decode("utf-8", "replace"))
                ):
                    yield Diagnostic(text.position, "warning", wrong)


def _wrong_sender(function: str, text: str) -> str:
    if function == "caller" and text and not text.startswith("/"):
        return f"the name of a node begins with `/`, so this is never equal; write {shown('/' + text)}"
    if function != "host" or not text:
        return ""
    try:
        plain = str(ip_address(text))
    except ValueError:
        why = "`host` is an address such as 10.0.0.7, and never a name or a group"
        return f"{why}, so this is never equal; write the address of {shown(text)}"
    return (
        ""
        if plain == text
        else f"`host` has this address as {shown(plain)}, so this is never equal; write that"
    )


def _always_dropped(event: tree.EventDefinition) -> Iterator[Diagnostic]:
    decides = any(
        isinstance(node, tree.IfStatement | tree.SwitchStatement) for node in tree.walk(event.action)
    )
    if isinstance(event.trigger, tree.MessageTrigger) and decides and _ends(event.action):
        text = (
            f"{shown(event.name)} drops every message, because each path ends with `return;`, which drops it"
        )
        yield Diagnostic(
            event.position, "warning", f"{text}; leave out the `return;` of the path that passes"
        )


def _ends(statement: tree.Statement | None) -> bool:
    match statement:
        case tree.ReturnStatement():
            return True
        case tree.Block(statements=statements):
            return any(isinstance(one, tree.DropStatement) or _ends(one) for one in statements)
        case tree.IfStatement(yes=yes, no=no):
            return _ends(yes) and _ends(no)
    return False


def _acts(statement: tree.Statement) -> bool:
    return _ends(statement) or any(
        isinstance(node, tree.DropStatement | tree.StopStatement) for node in tree.walk(statement)
    )


def _lost_changes(event: tree.EventDefinition) -> Iterator[Diagnostic]:
    fields = {parameter.name for parameter in event.parameters}
    for block in tree.walk(event.action):
        if not isinstance(block, tree.Block):
            continue
        stops = any(isinstance(statement, tree.StopStatement) for statement in block.statements)
        if not stops and not _ends(block):
            continue
        how, word = ("replaces", "STOP;") if stops else ("drops", "return;")
        for statement in block.statements:
            if isinstance(statement, tree.ExpressionStatement) and (name := _assigned(statement)) in fields:
                text = f"the new value of {shown(name)} is lost, because this path {how} the message"
                yield Diagnostic(
                    statement.position,
                    "warning",
                    f"{text}; to send the changed message, leave out the `{word}`",
                )


def _assigned(statement: tree.ExpressionStatement) -> str:
    target = statement.expression
    if not isinstance(target, tree.Assignment):
        return ""
    place: object = target.target
    while not isinstance(place, tree.Name):
        if not isinstance(place, tree.SyntaxNode):
            return ""
        place = tree.fields_of(place)[1]
    return place.parts[0]


def _passed_nan(event: tree.EventDefinition) -> Iterator[Diagnostic]:
    """Warn of bounds that NaN passes: each comparison with NaN is false, and `std::min` may return it."""
    numbers = {one.name for one in event.parameters if one.type.name in _FLOATING}
    if isinstance(event.trigger, tree.MessageTrigger) and event.trigger.when is not None:
        yield from _bounds(event.trigger.when, event.action, numbers)
    for node in tree.walk(event.action):
        match node:
            case tree.IfStatement(condition=condition, yes=yes, no=None):
                yield from _bounds(condition, yes, numbers)
            case tree.Assignment(
                target=tree.Name(parts=(name,)),
                value=tree.ConditionalExpression(condition=condition, no=tree.Name(parts=(other,))),
            ) if name == other and name in numbers:
                yield from (_nan_passes(name, bound) for bound in _unordered(condition, {name}))
            case tree.CallExpression(callee=tree.Name(parts=parts)) if parts in _MIN_MAX:
                for name in sorted(numbers & {_name(argument) for argument in node.arguments}):
                    text = f"`{parts[-1]}` passes NaN in {shown(name)} on, or takes it for the other bound"
                    yield Diagnostic(node.position, "warning", f"{text}; test it with `isnan` before")


def _bounds(
    condition: tree.Expression, yes: tree.Statement, numbers: frozenset[str] | set[str]
) -> Iterator[Diagnostic]:
    changed = numbers if _acts(yes) else numbers & _assigned_in(yes)
    for bound in _unordered(condition, changed):
        name = next(name for name in sorted(changed) if name in {_operand(bound.left), _operand(bound.right)})
        yield _nan_passes(name, bound)


def _unordered(
    condition: tree.Expression, names: frozenset[str] | set[str]
) -> Iterator[tree.BinaryExpression]:
    parts = [node for node in tree.walk(condition) if isinstance(node, tree.Expression)]
    if any(isinstance(node, tree.UnaryExpression) and node.operator == "!" for node in parts):
        return
    waiting = [condition]
    while waiting:
        match waiting.pop():
            case tree.BinaryExpression(operator="||" | "&&", left=left, right=right):
                waiting += [right, left]
            case tree.BinaryExpression(operator=operator) as bound if operator in _UNORDERED:
                if names & {_operand(bound.left), _operand(bound.right)}:
                    yield bound


def _nan_passes(name: str, bound: tree.BinaryExpression) -> Diagnostic:
    text = f"NaN passes this bound of {shown(name)}, because each comparison with NaN is false; use `clamp`,"
    text += " negate the opposite comparison (`!(x <= 1)`), or use `isnan`"
    return Diagnostic(bound.position, "warning", text)


def _operand(node: tree.Expression) -> str:
    match node:
        case tree.CallExpression(callee=tree.Name(parts=parts), arguments=(argument,)) if (
            parts[-1] in _ABSOLUTE
        ):
            return _name(argument)
    return _name(node)


def _name(node: tree.Expression) -> str:
    return node.parts[0] if isinstance(node, tree.Name) else ""


def _assigned_in(statement: tree.Statement) -> set[str]:
    return {_assigned(node) for node in tree.walk(statement) if isinstance(node, tree.ExpressionStatement)}


def rival_changes(specifications: Sequence[tree.Specification], phases: Phases) -> Iterator[Diagnostic]:
    """Warn of fields that two specifications change, where the later decides. Pairs in `phases` are intended."""
    changed = [
        (specification, topic, field, binding)
        for specification in specifications
        for topic, field, binding in _changes(specification)
    ]
    seen: set[tuple[str, str, str]] = set()
    for (first, topic, one, _), (second, there, other, binding) in combinations(changed, 2):
        same = one == other or one.startswith(f"{other}.") or other.startswith(f"{one}.")
        key = first.name, second.name, topic
        if (first.name, second.name) in phases:
            continue
        if first is not second and topic == there and same and key not in seen:
            seen.add(key)
            text = f"{first.name} also changes {other} of {topic}; the order of the files decides: {second.name} has"
            text = f"{text} the last word; write `order {first.name} < {second.name};`, or the reverse"
            yield Diagnostic(binding.position, "warning", text)


def _changes(specification: tree.Specification) -> Iterator[tuple[str, str, tree.Binding]]:
    for event in specification.events:
        if isinstance(event.trigger, tree.MessageTrigger):
            assigned = _assigned_in(event.action)
            for binding in event.trigger.pattern:
                if binding.variable in assigned:
                    path = ".".join(
                        step.name if step.index is None else f"{step.name}[{step.index}]"
                        for step in binding.path
                    )
                    yield event.trigger.topic, path, binding
