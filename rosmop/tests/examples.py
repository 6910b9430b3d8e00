"""A property test runs a sixth of its examples, or all of them with `TESTS_EXAMPLES=all`.

@settings(max_examples=examples(400))
"""

import os


def examples(many: int) -> int:
    return many if os.environ.get("TESTS_EXAMPLES") == "all" else many // 6
