"""Resolve names as rosmaster does, one JSON request and answer a line; Debian's Python runs this file."""

import json
import sys

from rosgraph.names import resolve_name  # type: ignore[import-not-found]  # Debian's Python has it
from rosmaster.validators import ParameterInvalid, is_topic  # type: ignore[import-not-found]  # as above

for line in sys.stdin:
    name, caller_id = json.loads(line)
    try:
        topic = is_topic("topic")(name, caller_id)
    except ParameterInvalid:
        topic = None
    sys.stdout.write(json.dumps([resolve_name(name, caller_id), topic]) + "\n")
    sys.stdout.flush()
