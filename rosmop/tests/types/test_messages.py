import time

from rosmop.types.messages import nearest


def test_the_nearest_name() -> None:
    assert nearest("positon", ["name", "position"]) == "; did you mean `position`?"
    assert nearest("xyz", ["name", "position"]) == "; known: name, position"


def test_thousands_of_names_and_mistakes_cost_little() -> None:
    known = [f"function{number}" for number in range(100_000)]
    began = time.process_time()
    for number in range(5):
        nearest(f"funktion{number}", known)
    assert time.process_time() - began < 1
