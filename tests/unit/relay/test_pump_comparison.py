"""The pump does what the path in Python does (docs/dev/assurance.md)."""

import os

import pytest

from tests.support.examples import examples
from tests.unit.relay.pump_comparison import PumpComparison


@pytest.mark.timeout(600)
def test_the_pump_has_the_same_effects_as_python() -> None:
    """Subscribers get the same bytes, and counts, effects and state of monitors are the same; both paths are used."""
    seed = int.from_bytes(os.urandom(4))
    comparison = PumpComparison(seed)
    try:
        comparison.run(examples(18_000))
    except AssertionError as error:
        raise AssertionError(f"python -m tests.unit.relay.pump_comparison {seed} 18000: {error}") from error
    finally:
        comparison.close()
    done = comparison.done
    assert done["pump: without Python"] > 5 + done["plain: without Python"]
