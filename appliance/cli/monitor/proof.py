"""What `rosrv monitor check --prove` says: of each event on a topic or service, whether its module is proved right."""

import time

from appliance.cli.output import say, say_json
from rosmop.prove.equality import findings_of
from rosmop.run.engine import MonitorSet


def say_proofs(monitors: MonitorSet, *, as_json: bool) -> int:
    """Write them; how many events' code does something else than the event means."""
    different = 0
    for found in findings_of(monitors.compiled, time.monotonic):
        different += found.differs
        if as_json:
            say_json(
                {"topic": found.topic, "event": found.event, "proof": found.answer, "differs": found.differs}
            )
        else:
            say(f"{found.event} on {found.topic}: {found.answer}", "red" if found.differs else "")
    return different
