"""An object gets its functions when it is made: no attribute for a function may stay empty."""

import ast
from collections.abc import Iterator

from tests.support.sources import ROOT, product_files


def test_no_slot_can_stay_unfilled() -> None:
    """No attribute begins as None, or as a function that does nothing, and gets its function from another file.

    If such a slot is forgotten, it silently does nothing. Make the function an argument of the constructor, which
    cannot be forgotten.
    """
    begun: dict[object, set[str]] = {}
    filled: dict[str, set[object]] = {}
    for path in product_files():
        tree = ast.parse(path.read_text(encoding="utf-8"))
        begun[path.relative_to(ROOT)] = set(slots(tree))
        for name in set_elsewhere(tree):
            filled.setdefault(name, set()).add(path.relative_to(ROOT))
    unfilled = [
        f"{path}: {name}, filled in {sorted(map(str, others))}"
        for path, names in begun.items()
        for name in names
        if (others := filled.get(name, set()) - {path})
    ]
    assert unfilled == []


def test_the_rule_finds_what_it_forbids() -> None:
    """Covers a lambda, None, a class that makes nothing, and a field of a dataclass."""
    for value in ("lambda: None", "lambda topic: 0", "None", "dict", "lambda *_: ''", "lambda: False"):
        assert list(slots(ast.parse(f"self.changed: Callable[[], int] | None = {value}"))) == ["changed"], (
            value
        )
        assert list(slots(ast.parse(f"changed: 'Callable[[], None]' = {value}"))) == ["changed"], value
    assert list(slots(ast.parse("self.changed = lambda: None"))) == ["changed"]
    for text in (
        "self.changed = changed",
        "self.n: int = 0",
        "self.task: Task | None = None",
        "x.y = lambda: 0",
    ):
        assert not list(slots(ast.parse(text))), text
    for text in ("parts.hosts.changed = f", "x.changed, x.lost = f, g", "x.changed: Callable[[], None] = f"):
        assert "changed" in set(set_elsewhere(ast.parse(text))), text
    assert not list(set_elsewhere(ast.parse("self.changed = f")))


def slots(tree: ast.Module) -> Iterator[str]:
    """Yield the attributes for functions that begin empty, or with a function that does nothing."""
    for node in ast.walk(tree):
        match node:
            case ast.AnnAssign(target=target, annotation=annotation, value=ast.expr() as value):
                if empty(value) and "Callable" in ast.unparse(annotation):
                    yield from own(target)
            case ast.Assign(targets=[ast.Attribute() as target], value=ast.Lambda() as value) if empty(value):
                yield from own(target)


def own(target: ast.expr) -> Iterator[str]:
    """Yield the name of an object's own attribute, or of a field of a class."""
    match target:
        case ast.Attribute(value=ast.Name(id="self"), attr=name) | ast.Name(id=name):
            yield name


def empty(value: ast.expr) -> bool:
    """Whether this is None, or a function that ignores its arguments and returns nothing."""
    match value:
        case ast.Constant(value=None) | ast.Name(id="dict" | "list" | "set" | "str" | "int" | "bool"):
            return True
        case ast.Lambda(body=ast.Constant() | ast.Name()):
            return True
    return False


def set_elsewhere(tree: ast.Module) -> Iterator[str]:
    """Yield the attributes of other objects that are set."""
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else []
        if isinstance(node, ast.AnnAssign):
            targets = [node.target]
        for target in targets:
            for each in target.elts if isinstance(target, ast.Tuple) else [target]:
                match each:
                    case ast.Attribute(value=ast.Name(id="self" | "cls")):
                        pass
                    case ast.Attribute(attr=name):
                        yield name
