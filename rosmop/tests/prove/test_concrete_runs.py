import pytest

from rosmop.fast.batch_codegen import written_of
from rosmop.prove.decoding import functions_of
from rosmop.tests.prove.encoding import with_function
from rosmop.tests.prove.module_mutants import FAULTY, compiled, event
from rosmop.tests.prove.preset_faults import difference

COUNTED = event("if (x < 3) { n++; }", "int x", "count:x", "int n = 0;")


@pytest.mark.parametrize("name", FAULTY)
def test_interpreter_and_module_agree_on_a_right_module(name: str) -> None:
    assert difference(FAULTY[name], FAULTY[name]) is None


@pytest.mark.parametrize(
    ("right", "wrong", "what"),
    [
        ("x < 3", "x <= 3", "the variable"),
        ("n++", "DROP", "dropped"),
        ("n++", "x = 3", "changed"),
        ("n++;", "", "the variable"),
        ("x < 3", "x < 3 || n > 1000", "the variable"),
    ],
)
def test_a_run_shows_a_wrong_module(right: str, wrong: str, what: str) -> None:
    assert what in (difference(COUNTED, COUNTED.replace(right, wrong)) or "")


def test_a_difference_of_the_budget_is_not_one_of_the_effect() -> None:
    assert difference(COUNTED, COUNTED.replace("n++", "n++; n + 0")) is None


def test_a_module_of_decoded_functions_is_the_same_module() -> None:
    module = written_of(compiled(FAULTY["names that are kept, and seconds"])).code
    codes = functions_of(module)
    for number, code in enumerate(codes):
        assert functions_of(with_function(module, number, code)) == codes
