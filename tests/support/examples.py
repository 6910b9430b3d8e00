"""Set the number of examples of a property: a sixth in each run, all in `make nightly`.

With `CI=true` Hypothesis derives the seed from the test; otherwise each run has a new seed.

@settings(max_examples=examples(400))
"""

import os


def examples(many: int) -> int:
    return many if os.environ.get("TESTS_EXAMPLES") == "all" else many // 6
