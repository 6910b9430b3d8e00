"""Change the kernel in small wrong ways, and list the changes that no test of the gate finds: `make mutants N=200`.

Every module is loaded with all its mutants inside, each switched on by a number. A first run records which tests
reach which mutant; then a fork for each mutant runs only those tests, until one fails. `--all` adds tests outside the
gate; `--module master` changes the modules whose path contains `master` instead of the kernel. A seed always chooses
the same mutants, whichever the tests reach, so that two versions of the tests can be compared. Changes without an
effect are left out, such as None instead of False, or a `zip` that is not strict.
"""

import argparse
import ast
import builtins
import importlib
import importlib.abc
import importlib.machinery
import json
import os
import random
import select
import signal
import sys
import tempfile
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.support.sources import kernel_modules

ROOT = Path(__file__).parents[1]
_KERNEL = [path.removesuffix(".py") for path in kernel_modules() if path.endswith(".py")]
FOLDERS = ("tests/unit", "tests/world", "lab/tests")
_OPPOSITES: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_REACHED = "__reached_mutant__"


def modules_of(part: str) -> dict[str, Path]:
    paths = _KERNEL
    if part:
        found = (ROOT / "appliance").rglob("*.py")
        paths = [str(file.relative_to(ROOT / "appliance").with_suffix("")) for file in found]
        paths = sorted(path for path in paths if part in path and not path.endswith("__init__"))
    return {f"appliance.{path.replace('/', '.')}": ROOT / "appliance" / f"{path}.py" for path in paths}


class _Switches(ast.NodeTransformer):
    def __init__(self, module: str, first: int) -> None:
        self._module, self._number, self._functions = module, first, 0
        self.described: list[str] = []

    def _reached(self, node: ast.AST, what: str) -> ast.expr:
        number = self._number + len(self.described)
        self.described.append(f"{self._module}:{getattr(node, 'lineno', 0)}: {what}")
        return ast.Call(ast.Name(_REACHED, ast.Load()), [ast.Constant(number)], [])

    def _or(self, node: ast.expr, wrong: ast.expr, what: str) -> ast.expr:
        return ast.copy_location(ast.IfExp(self._reached(node, what), wrong, node), node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        self._functions += 1
        node.body = [self.visit(statement) for statement in node.body]
        self._functions -= 1
        return node

    visit_AsyncFunctionDef = visit_FunctionDef  # type: ignore[assignment]  # noqa: N815  the name that ast calls

    def visit_match_case(self, node: ast.match_case) -> ast.match_case:
        node.body = [self.visit(statement) for statement in node.body]  # a pattern takes no expression
        return node

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        self.generic_visit(node)
        opposite = _OPPOSITES.get(type(node.ops[0]))
        if not self._functions or opposite is None or len(node.ops) > 1:
            return node
        wrong = ast.Compare(node.left, [opposite()], node.comparators)
        return self._or(node, wrong, f"{ast.unparse(node)} -> {ast.unparse(wrong)}")

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        text = ast.unparse(node)
        self.generic_visit(node)
        if not self._functions:
            return node
        wrong = ast.BoolOp(ast.And() if isinstance(node.op, ast.Or) else ast.Or(), node.values)
        return self._or(node, wrong, f"and/or exchanged: {text}")

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        text = ast.unparse(node)
        self.generic_visit(node)
        if not self._functions or not isinstance(node.op, ast.Not):
            return node
        return self._or(node, node.operand, f"{text} -> without not")

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.AST:
        counts = isinstance(node.target, ast.Attribute) and node.target.attr == "version"
        return node if counts else self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        if ast.unparse(node.func) == "zip":
            node.args = [self.visit(argument) for argument in node.args]
            return node
        return self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if not self._functions or not isinstance(node.value, bool | int):
            return node
        wrong = ast.Constant(not node.value if isinstance(node.value, bool) else node.value + 1)
        return self._or(node, wrong, f"{node.value!r} -> {wrong.value!r}")

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.AST:
        return node  # a text decides nothing

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        text = ast.unparse(node)
        self.generic_visit(node)
        is_call = isinstance(node.value, ast.Call) or (
            isinstance(node.value, ast.Await) and isinstance(node.value.value, ast.Call)
        )
        if not self._functions or not is_call:
            return node
        left_out = ast.UnaryOp(ast.Not(), self._reached(node, f"left out: {text}"))
        return ast.copy_location(ast.If(left_out, [node], []), node)

    def visit_Return(self, node: ast.Return) -> ast.AST:
        text = ast.unparse(node)
        self.generic_visit(node)
        if not self._functions or node.value is None or text in {"return None", "return False"}:
            return node
        node.value = self._or(node.value, ast.Constant(None), f"{text} -> return None")
        return node


class MutantLoader(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def __init__(self, modules: dict[str, Path]) -> None:
        self.modules = modules
        self.described: list[str] = []

    def find_spec(
        self, fullname: str, _path: Sequence[str] | None, _target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        file = self.modules.get(fullname)
        return None if file is None else importlib.machinery.ModuleSpec(fullname, self, origin=str(file))

    def exec_module(self, module: types.ModuleType) -> None:
        file = self.modules[module.__name__]
        module.__file__ = str(file)
        tree = ast.parse(file.read_text(encoding="utf-8"))
        switches = _Switches(str(file.relative_to(ROOT)), len(self.described))
        tree = ast.fix_missing_locations(switches.visit(tree))
        self.described += switches.described
        exec(compile(tree, file, "exec"), module.__dict__)  # noqa: S102  our own module


class Hunt:
    def __init__(
        self, loader: MutantLoader, number: int, seed: int, seconds: int, *, everything: bool
    ) -> None:
        self._loader, self._number, self._seed, self._everything = loader, number, seed, everything
        self._seconds = seconds
        self._reaches: dict[int, set[str]] = {}  # by mutant
        self._active = -1
        self._test = ""
        self.survivors: list[int] = []
        setattr(builtins, _REACHED, self._reached)

    def _reached(self, number: int) -> bool:
        if self._active < 0 and self._test:
            self._reaches.setdefault(number, set()).add(self._test)
        return number == self._active

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._test = nodeid

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items = session.items
        learned = self._fork(session, items, self._seconds * 10)
        if learned["failed"]:
            raise pytest.UsageError(f"without a mutant, these tests fail: {learned['failed']}")
        reaches: dict[str, list[str]] = learned["reaches"]
        reached = sorted(map(int, reaches))
        known = sorted(range(len(self._loader.described)), key=self._loader.described.__getitem__)
        sampled = known if self._everything else reached
        chosen = random.Random(self._seed).sample(sampled, min(self._number, len(sampled)))  # noqa: S311  a sample
        _say(
            f"{len(self._loader.described)} mutants, {len(reached)} reached by {len(items)} tests; {len(chosen)} chosen"
        )
        for count, number in enumerate(chosen, 1):
            self._active = number
            wanted = set(reaches.get(str(number), []))
            reaching = [item for item in items if item.nodeid in wanted]
            outcome = self._fork(session, reaching, self._seconds) if wanted else {"failed": []}
            found = ", ".join(outcome["failed"]) or "SURVIVED"
            self.survivors += [] if outcome["failed"] else [number]
            _say(f"{count}/{len(chosen)} {self._loader.described[number]}: {found[:120]}")
        _say(f"{len(chosen) - len(self.survivors)} of {len(chosen)} mutants were found; not found:")
        for number in self.survivors:
            _say(f"  {self._loader.described[number]}")
        return True

    def _fork(self, session: pytest.Session, items: list[pytest.Item], seconds: int) -> dict[str, Any]:
        with tempfile.NamedTemporaryFile("r") as answer:
            child = os.fork()
            if not child:
                # Time of the processor, because a busy machine is not a hang.
                signal.setitimer(signal.ITIMER_PROF, seconds)
                self._run(session, items, answer.name)
            ended = select.select([process := os.pidfd_open(child)], [], [], 10 * seconds)[0]
            os.close(process)
            if not ended:  # an alarm would not do: a test with a time limit sets its own
                os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            text = answer.read()
            return json.loads(text) if text else {"failed": ["it did not end"], "reaches": {}}

    def _run(self, session: pytest.Session, items: list[pytest.Item], answer: str) -> None:
        failed: list[str] = []
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        try:
            session.config.pluginmanager.register(_Failures(failed))
            for item, following in zip(items, [*items[1:], None], strict=True):
                session.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if failed and self._active >= 0:
                    break
            reaches = {number: sorted(tests) for number, tests in self._reaches.items()}
            Path(answer).write_text(json.dumps({"failed": failed, "reaches": reaches}), encoding="utf-8")
        finally:
            os.kill(os.getpid(), signal.SIGKILL)  # nothing of this process may run at its end


class _Failures:
    def __init__(self, failed: list[str]) -> None:
        self._failed = failed

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._failed.append(report.nodeid)


def _say(line: str) -> None:
    print(line, file=sys.__stdout__, flush=True)  # pytest captures the other one, as tests expect


def main() -> int:
    """Return 0: people judge the survivors."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--number", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--seconds", type=int, default=300, help="a mutant whose tests take longer is found: it hangs"
    )
    parser.add_argument("--all", action="store_true", help="also run tests that are not of the gate")
    parser.add_argument(
        "--module", default="", metavar="PART", help="part of the paths of the changed modules"
    )
    parser.add_argument(
        "tests", nargs="*", default=[folder for folder in FOLDERS if (ROOT / folder).exists()]
    )
    given = parser.parse_args()
    loader = MutantLoader(modules_of(given.module))
    sys.meta_path.insert(0, loader)
    hunt = Hunt(loader, given.number, given.seed, given.seconds, everything=bool(given.module))
    if given.module:
        for name in loader.modules:
            importlib.import_module(name)
    options = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=no", "--capture=sys"]
    options += [] if given.all else ["-m", "not nightly and not real"]
    return int(pytest.main([*options, *given.tests], plugins=[hunt]))


if __name__ == "__main__":
    sys.exit(main())
