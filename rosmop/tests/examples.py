"""The number of examples of a property test: a sixth in each run, all of them with `TESTS_EXAMPLES=all`.

@settings(max_examples=examples(400))
"""

import os


def examples(many: int) -> int:
    """Return the part of `many` that this run has time for."""
    return many if os.environ.get("TESTS_EXAMPLES") == "all" else many // 6
