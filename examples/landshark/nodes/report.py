"""Tells who started the program what happens: one JSON object per line on standard output."""

import json
import sys
import threading

_LOCK = threading.Lock()


def report(event, **fields):
    """Print one event."""
    with _LOCK:
        sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
        sys.stdout.flush()
