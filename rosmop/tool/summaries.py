"""The first sentence of each command's help, for a table of commands that loads none of them."""

from collections.abc import Mapping

SUMMARIES: Mapping[str, str] = {
    "check": "List all errors and warnings with line and column. Exit status 1 if there is an error.",
    "run": "Run the monitors on recordings, with the recorded times, and report on each message or recording.",
    "learn": "Propose specifications from recordings of a robot that behaves correctly, for you to edit.",
    "coverage": "List the events, branches, handlers, states and transitions that the recordings covered or missed.",
}
