"""Report events to the program's starter: one JSON object per line on standard output."""

import json
import os


def report(event, **fields):
    """Print one event with one write and no lock, because a signal handler may interrupt another report."""
    os.write(1, (json.dumps({"event": event, **fields}) + "\n").encode())
