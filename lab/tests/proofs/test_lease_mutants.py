from pathlib import Path

import pytest

from lab.proofs.spin import LeaseBounds, search

GRANTED_TWICE = LeaseBounds(grants=2)
AFTER_THE_LAST_FAULT = LeaseBounds(grants=1, last_fault=True)
MUTANTS = {
    "NOT_EXPIRED": ("single", GRANTED_TWICE),
    "ANY_APPLIANCE": ("whole", GRANTED_TWICE),
    "NOT_FENCED": ("fenced", GRANTED_TWICE),
    "SAME_EPOCH": ("whole", GRANTED_TWICE),
    "ANYBODY_REMOVES": ("whole", GRANTED_TWICE),
    "ALONE_UNASKED": ("whole", GRANTED_TWICE),
    "ADDED_EARLY": ("whole", GRANTED_TWICE),
    "OVERTAKEN": ("whole", GRANTED_TWICE),
    "COUNTED_LATE": ("whole", GRANTED_TWICE),
    "NO_LIMIT": ("single", GRANTED_TWICE),
    "RENEWAL_FROM_ANSWER": ("single", GRANTED_TWICE),
    "PROMISE_FROM_ANSWER": ("single", GRANTED_TWICE),
    "ACTIVE_DESPITE_PROMISE": ("single", GRANTED_TWICE),
    "STARTED_CLAIMING": ("single", GRANTED_TWICE),
    "STARTED_ACTIVE": ("single", GRANTED_TWICE),
    "HANDS_OVER_ACTIVE": ("single", GRANTED_TWICE),
    "BOOTS_OPEN": ("fenced", GRANTED_TWICE),
    "STARTED_EXPIRED": ("single", GRANTED_TWICE),
    "SET_FORGOTTEN": ("whole", GRANTED_TWICE),
    "WITNESS_EPOCH_FORGOTTEN": ("growing", GRANTED_TWICE),
    "STALE_STREAM": ("whole", GRANTED_TWICE),
    "EPOCH_FORGOTTEN": ("whole", GRANTED_TWICE),
    "NOT_ON_DISK": ("whole", GRANTED_TWICE),
    "PROMISES_ALWAYS": ("served", AFTER_THE_LAST_FAULT),
    "NEVER_REMOVES": ("served", AFTER_THE_LAST_FAULT),
    "RENEWED_SHUT": ("served", AFTER_THE_LAST_FAULT),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_wrong_rule_would_be_found(tmp_path: Path, mutant: str) -> None:
    broken, bounds = MUTANTS[mutant]
    assert search(tmp_path, bounds, mutant, large=True).broken == broken
