"""Replace the numbers in a text, so that two reports of one cause with other measured values have the same words.

Kept are digits that name something: in a word or ROS name (`joint_1`, `/arm/2`), an address or version (`10.0.0.66`),
and the place in a file (`robot.ini:12`).
"""

import re

_NUMBER = re.compile(
    r"(?P<place>\.\w++:\d++(?::\d++)*+)"
    r"|(?<![\w/.])[-+]?(?:nan\b|inf\b|\d++(?:\.\d++)?+(?:[eE][-+]?\d++)?+(?!\.\d))"
)
# Possessive, so the time is linear in the length of the text, parts of which may come from peers.


def without_numbers(text: str) -> str:
    """Return the text with `#` for each number."""
    return _NUMBER.sub(lambda found: found["place"] or "#", text)
