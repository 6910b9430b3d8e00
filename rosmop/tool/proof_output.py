"""Report the proofs of events."""

from rosmop.prove.equality import findings_of
from rosmop.run.engine import MonitorSet
from rosmop.tool.terminal import say, say_json


def say_proofs(monitors: MonitorSet, *, as_json: bool) -> int:
    different = 0
    for found in findings_of(monitors.compiled):
        different += found.differs
        if as_json:
            say_json(
                {"topic": found.topic, "event": found.event, "proof": found.answer, "differs": found.differs}
            )
        else:
            say(f"{found.event} on {found.topic}: {found.answer}", "red" if found.differs else "")
    if not as_json and any(specification.givens for specification in monitors.compiled.specifications):
        say("each proof holds for all values of given constants, not only for the defaults")
    return different
