"""Replace the numbers in a text, so that two reports of one cause with different measured values become equal.

Digits that name something are kept, as in `joint_1`, `10.0.0.66` and `robot.ini:12`.
"""

import functools
import re

_PART = r"[\da-fA-F]{1,4}+"
_IPV6 = rf"(?<![\w:.])(?:(?:{_PART}:){{1,7}}:[\da-fA-F:]*+|::[\da-fA-F:]++|(?:{_PART}:){{7}}{_PART})"
_NUMBER = re.compile(
    rf"(?P<kept>\.\w++:\d++(?::\d++)*|{_IPV6})"
    r"|(?<![\w/.])[-+]?(?:nan\b|inf\b|(?>\d++(?:\.\d++)?(?:[eE][-+]?\d++)?)(?!\.\d))"
)
# Possessive or atomic, so the time is linear in the length of the text, parts of which may come from peers.


@functools.lru_cache(4)  # a line of output is compared with the previous one
def without_numbers(text: str) -> str:
    return _NUMBER.sub(lambda found: found["kept"] or "#", text)
