"""How many examples a property is tried on: a sixth in each run, other ones each time; all in `make test-system`.

@settings(max_examples=examples(400))
"""

import os


def examples(many: int) -> int:
    """So many of `many` as this run has time for."""
    return many if os.environ.get("TESTS_EXAMPLES") == "all" else many // 6
