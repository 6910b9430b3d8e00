"""`ere` and `ltl` beside RV-Monitor: `python -m benchmarks.rv_monitor CHECKOUT JAVACC [FORMULAS] [--seed SEED]`.

CHECKOUT is RV-Monitor's repository (github.com/runtimeverification/rv-monitor), JAVACC the archive of JavaCC
(Debian's package `javacc`: /usr/share/java/javacc.jar); `javac` and `java` are on the path. Its plugins, compiled
without the parts that read and write XML, make automata of random expressions and formulas, some with `(*)`, `<*>`
and `S` about the past. On random traces, both sides must report `match` and `violation` at the same events; otherwise
the exit status is 1. It is 2 if there is no automaton of a logic. RV-Monitor may report `fail` and `violation` later,
because it does not always detect that no continuation matches. Where it is later for an `ltl` formula, the definition
must give `violation` at the earlier event.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from rosmop.tests.logics import test_ere as ere
from rosmop.tests.logics import test_ltl as ltl
from rosmop.tests.logics.driving import ABC, compiled, seeded, told
from rosmop.tests.logics.temporal import draw

_PLUGINS = "com/runtimeverification/rvmonitor/logicrepository/plugins"
_TRACES, _LONGEST = 40, 12
_WORDS = {
    "not": "not", "next": "o", "always": "[]", "eventually": "<>", "until": "U", "release": "R", "previously": "(*)",
    "once": "<*>", "since": "S", "implies": "=>", "iff": "<=>",
}  # fmt: skip
_DRIVER = """
import java.io.*;
import com.runtimeverification.rvmonitor.logicrepository.plugins.ere.*;
import com.runtimeverification.rvmonitor.logicrepository.plugins.ere.parser.EREParser;
public class Driver {
  static String made(String logic, String[] events, String text) {
    if (logic.equals("ltl"))
      return com.runtimeverification.rvmonitor.logicrepository.plugins.ltl.Made.of(text);
    Symbol[] symbols = new Symbol[events.length];
    for (int i = 0; i < events.length; i++) symbols[i] = Symbol.get(events[i]);
    ByteArrayOutputStream out = new ByteArrayOutputStream();
    FSM.get(EREParser.parse(text).getERE(), symbols).print(new PrintStream(out));
    return out.toString();
  }
  public static void main(String[] none) throws Exception {
    BufferedReader in = new BufferedReader(new InputStreamReader(System.in));
    for (String line; (line = in.readLine()) != null; ) {
      String[] parts = line.split("\\t"), said = {""};
      Thread one = new Thread(null, () -> {
        try { said[0] = made(parts[0], parts[1].split(" "), parts[2]); } catch (Throwable error) { }
      }, "one", 1 << 28);
      one.setDaemon(true);
      one.start();
      one.join(2000);  // some formulas have too many states
      if (one.isAlive()) one.stop();
      System.out.println(said[0].replaceAll("\\\\s+", " ").trim());
    }
  }
}
"""
_LTL = """package com.runtimeverification.rvmonitor.logicrepository.plugins.ltl;
import com.runtimeverification.rvmonitor.logicrepository.plugins.ltl.parser.LTLParser;
public class Made { public static String of(String text) {
  LTLFormula formula = LTLParser.parse(text).getFormula().simplify();
  return new DFA(new NFA(new BA(new GBA(new AAutomaton(formula))))).toString(); } }
"""


class Formula(NamedTuple):
    """A random formula as a tree, and as text with all parentheses."""

    logic: str
    events: Sequence[str]
    tree: Any
    text: str


def _shown(tree: Any) -> str:
    kind, *operands = tree
    if kind == "event":
        return str(operands[0])
    if kind == "^":
        return f"({' '.join([_shown(operands[0])] * operands[1])})" if operands[1] else "epsilon"
    texts = [_shown(operand) for operand in operands]
    sign = _WORDS.get(kind, "" if kind == "cat" else kind)
    if kind in ("*", "+"):
        return f"({texts[0]}{sign})"
    return f"({texts[0]} {sign} {texts[1]})" if len(texts) == 2 else f"({sign} {texts[0]})" if texts else sign


def drawn(random: Random, count: int) -> Iterator[Formula]:
    arity = ltl.UNARY | dict.fromkeys(("previously", "once"), 1)
    operators = (*ltl.TEMPORAL, "previously", "once", "since")
    for _ in range(count):
        tree: Any = ere.draw(random, 3)
        yield Formula("ere", ABC, tree, _shown(tree))
        while not ltl.has(tree := draw(random, 2, operators, arity, ltl.AB), ltl.TEMPORAL):
            pass
        yield Formula("ltl", ltl.AB, tree, _shown(tree))


def automata(checkout: Path, javacc: Path, formulas: Sequence[Formula]) -> list[str]:
    """Return RV-Monitor's automata, with "" for a formula from which it cannot make one."""
    with tempfile.TemporaryDirectory() as made:
        sources, classes = Path(made) / "sources", Path(made) / "classes"
        for logic in ("ere", "ltl"):
            plugin, parser = checkout / "plugins_logicrepository" / logic / "src" / "main", logic.upper()
            shutil.copytree(plugin / "java", sources, dirs_exist_ok=True)
            (sources / _PLUGINS / logic / f"{parser}Plugin.java").unlink()  # these files read and write XML
            grammar = plugin / "javacc" / _PLUGINS / logic / "parser" / f"{parser}Parser.jj"
            folder = sources / _PLUGINS / logic / "parser"
            _run(["java", "-cp", str(javacc), "javacc", f"-OUTPUT_DIRECTORY={folder}", str(grammar)])
        (sources / "Driver.java").write_text(_DRIVER)
        (sources / _PLUGINS / "ltl" / "Made.java").write_text(_LTL)
        _run(["javac", "-nowarn", "-d", str(classes), *map(str, sources.rglob("*.java"))])
        given = "".join(f"{one.logic}\t{' '.join(one.events)}\t{one.text}\n" for one in formulas)
        return _run(["java", "-cp", str(classes), "Driver"], given).splitlines()


def _run(command: list[str], given: str = "") -> str:
    done = subprocess.run(command, input=given, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{command[0]} failed: {done.stderr or done.stdout}")
    return done.stdout


def theirs(automaton: str, logic: str, trace: Sequence[str]) -> list[tuple[bool, bool]]:
    """Return, after each event, whether the automaton matches and whether no continuation can match."""
    states: dict[str, dict[str, str]] = {}
    for name, body in re.findall(r"(\w+) ?\[([^\]]*)\]", automaton):
        states[name] = dict(re.findall(r"(\w+) -> (\w+)", body))
        if other := re.search(r"default (\w+)", body):
            states[name]["default"] = other[1]
    matching = "".join(re.findall(r"alias match = (.*)", automaton)).split()
    state: str | None = next(iter(states)) if logic == "ltl" else "s0"
    said = []
    for event in trace:
        after = {} if state is None else states.get(state, {})
        state = after.get(event, after.get("default"))
        said.append((state in matching, state in (None, "violation")))
    return said


def _violated(tree: Any, trace: tuple[str, ...]) -> bool:
    endless = [
        ltl.unrolled(one, 6) for one in ltl.lassos(ltl.AB, len(trace) + 1, 3) if one[0][: len(trace)] == trace
    ]
    return not any(ltl.holds(tree, one)[0] for one in endless)


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("javacc", type=Path)
    parser.add_argument("formulas", type=int, nargs="?", default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    random, counts, wrong = seeded(options.seed), Counter[str](), 0
    formulas = list(drawn(random, options.formulas))
    made = automata(options.checkout, options.javacc, formulas)
    for logic in ("ere", "ltl"):
        if not any(automaton for one, automaton in zip(formulas, made, strict=True) if one.logic == logic):
            sys.stderr.write(
                f"RV-Monitor makes no automaton of any {logic} formula: is {options.checkout} its repository?\n"
            )
            return 2
    for one, automaton in zip(formulas, made, strict=True):
        counts[
            f"{one.logic}: {'formulas' if automaton else 'formulas of which RV-Monitor makes nothing'}"
        ] += 1
        monitor = compiled(one.logic, one.text, one.events)
        for _ in range(_TRACES if automaton else 0):
            trace = tuple(random.choices(one.events, k=random.randint(1, _LONGEST)))
            for place, (said, (matches, over)) in enumerate(
                zip(told(monitor, trace), theirs(automaton, one.logic, trace), strict=True), 1
            ):
                ends = bool({"fail", "violation"}.intersection(said))
                right = ("match" in said) == matches and (ends or not over)
                if right and ends and not over:
                    counts[f"{one.logic}: events at which it is later"] += 1
                    right = one.logic == "ere" or place > 3 or _violated(one.tree, trace[:place])
                counts[f"{one.logic}: events"] += 1
                if not right:
                    wrong += 1
                    sys.stdout.write(
                        f"{one.logic}: {one.text} on {trace[:place]}: {said}, {matches}, {over}\n"
                    )
    sys.stdout.writelines(f"{name}: {count}\n" for name, count in sorted(counts.items()))
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
