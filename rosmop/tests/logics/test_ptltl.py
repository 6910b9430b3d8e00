import pytest

from rosmop.logics import past_monitors
from rosmop.logics.interface import FiniteProperty
from rosmop.logics.past_monitors import PastProperty
from rosmop.tests.examples import examples
from rosmop.tests.logics.driving import ABC, compiled, seeded, told, traces
from rosmop.tests.logics.temporal import CONNECTIVES, Printer, Tree, draw

ARITY = {"not": 1, "previously": 1, "weakly previously": 1, "once": 1, "historically": 1}
TEMPORAL = ("previously", "weakly previously", "once", "historically", "since", "dual since")
PRINTER = Printer(
    {
        "previously": ("(*)",),
        "weakly previously": ("~(*)",),
        "once": ("<*>",),
        "historically": ("[*]",),
        "since": ("S",),
        "dual since": ("~S",),
    },
    [["since", "dual since"], ["and"], ["xor"], ["or"], ["implies", "iff"]],
    ["implies", "iff"],
)


def holds(tree: Tree, trace: tuple[str, ...], i: int) -> bool:  # noqa: PLR0911  # one per operator
    operator, *operands = tree

    def at(operand: int, position: int) -> bool:
        return holds(operands[operand], trace, position)

    past = range(i + 1)
    match operator:
        case "event":
            return bool(trace[i] == operands[0])
        case "true" | "false":
            return bool(operator == "true")
        case _ if operator in CONNECTIVES:
            return CONNECTIVES[operator](*(at(one, i) for one in range(len(operands))))
        case "previously":
            return i > 0 and at(0, i - 1)
        case "weakly previously":
            return i == 0 or at(0, i - 1)
        case "once":
            return any(at(0, j) for j in past)
        case "historically":
            return all(at(0, j) for j in past)
        case "since":
            return any(at(1, j) and all(at(0, k) for k in range(j + 1, i + 1)) for j in past)
        case "dual since":
            return all(at(1, j) or any(at(0, k) for k in range(j + 1, i + 1)) for j in past)
    raise AssertionError(operator)


@pytest.mark.parametrize("folded", [past_monitors.MAX_FOLDED, 0])
def test_table_and_folded_program_agree(folded: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(past_monitors, "MAX_FOLDED", folded)
    random = seeded(8)
    for _ in range(examples(40)):
        tree = draw(random, 4, TEMPORAL, ARITY, ("a", "b"))
        text = PRINTER.show(tree, random)
        wide = " xor ".join("((*) " * number + "c" + ")" * number for number in range(1, 16))
        small = compiled("ptltl", text, ABC)
        large = compiled("ptltl", f"({text}) xor ({wide}) xor ({wide})", ABC)
        assert isinstance(small, FiniteProperty)
        assert isinstance(large, PastProperty)
        trace = random.choices(ABC, k=60)
        assert told(small, trace) == told(large, trace), text


def test_since_groups_leftwards_and_binds_tighter_than_and() -> None:
    for word in traces(ABC, 4):
        assert told(compiled("ptltl", "a S b S c"), word) == told(compiled("ptltl", "(a S b) S c"), word)
        assert told(compiled("ptltl", "a or b S c and !a"), word) == told(
            compiled("ptltl", "a or ((b S c) and (!a))"), word
        )


def test_a_wide_formula_is_accepted() -> None:
    text = " xor ".join(["<*> a", *["b"] * 10_000])
    assert told(compiled("ptltl", text), "ab") == [("validation",), ("validation",)]
