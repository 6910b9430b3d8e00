"""Report events to the program that started a node: one JSON object per line, or words for a person.

The containers of compose.yaml set LANDSHARK_REPORTS=words.
"""

import json
import os

WORDS = {
    "connected": "the operator has the controls",
    "drove": "drove {metres} m",
    "aimed": "aimed the gun: tilt {tilt:.2f} rad",
    "fired": "fired: {shots} shot",
    "lost": "the robot's odometry is late",
    "regained": "the odometry arrives again, after {seconds} s",
}
QUIET = ("position",)  # it comes every second


def report(event, **fields):
    """Write a line in one system call and without a lock, because a signal handler may interrupt another report."""
    if os.environ.get("LANDSHARK_REPORTS") != "words":
        line = json.dumps({"event": event, **fields}, default=str)
    elif event in QUIET:
        return
    elif event == "attacked":
        line = in_words(**fields)
    else:
        line = WORDS[event].format(**fields)
    os.write(1, (line + "\n").encode())


def in_words(attack, succeeded, tried, answer):
    text = next((part for part in answer if isinstance(part, str)), "")
    if answer and isinstance(answer[-1], dict):
        text = f"{answer[-1]['drivers']} drivers of the robot took its messages"
    return f"{'allowed' if succeeded else 'denied':9} {attack}: {tried}\n          {text[:200]}"
