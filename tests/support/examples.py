"""Run a sixth of a property's examples each time, and all in `make nightly`.

With `CI=true` Hypothesis derives the seed from the test; otherwise each run has a new seed.
"""

import os


def examples(many: int) -> int:
    return many if os.environ.get("TESTS_EXAMPLES") == "all" else many // 6
