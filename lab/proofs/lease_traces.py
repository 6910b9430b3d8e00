"""Decide whether a list of events is an execution of the model of the lease (`lab/proofs/lease.pml`).

An event is a line. X and Y are the names of the two appliances, P is one of them or `witness`, E is the epoch of the
witness. The lines are in the order in which the events happened; a program must not leave out any.

    granted X E          the witness has granted the lease, and its firewall admits X
    renewed X E          the witness has renewed the lease of the holder
    released X E         the witness has let the lease expire for the holder, which is passive
    refused X REASON     the witness has refused a request of X
    removed Y by X E     the witness has removed Y from the in-sync set for the holder
    added Y by X E       the witness has added Y to the in-sync set for the holder
    promised Y to X      X has received a promise of Y not to claim
    active X E           X has become active, or has got a later epoch while it was active
    passive X            X has become passive, or was paused
    crashed P            P has ended; its memory is lost
    started P            P has started
    rebooted witness     the robot has lost its power
    acknowledged X N     X has answered the write N, each once

A reason that says `Y holds …` (Y is not X) or `X is not in sync` is checked. A trace begins with no holder, empty logs,
and any in-sync set; each process is up or down. A pause of an appliance may show as `passive` and `active`.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lab.proofs.spin import LEASE, Model, Step, accepts

_MAX_EPOCHS = 250
_WITNESS = "witness"
_FORMS = {
    "granted": r"(?P<who>\S+) (?P<epoch>\d+)",
    "renewed": r"(?P<who>\S+) (?P<epoch>\d+)",
    "released": r"(?P<who>\S+) (?P<epoch>\d+)",
    "refused": r"(?P<who>\S+) (?P<reason>.+)",
    "removed": r"(?P<other>\S+) by (?P<who>\S+) (?P<epoch>\d+)",
    "added": r"(?P<other>\S+) by (?P<who>\S+) (?P<epoch>\d+)",
    "promised": r"(?P<who>\S+) to (?P<other>\S+)",
    "active": r"(?P<who>\S+) (?P<epoch>\d+)",
    "passive": r"(?P<who>\S+)",
    "crashed": r"(?P<process>\S+)",
    "started": r"(?P<process>\S+)",
    "rebooted": r"(?P<process>witness)",
    "acknowledged": r"(?P<who>\S+) (?P<number>\d+)",
}


@dataclass(frozen=True, slots=True)
class TraceBounds:
    first: int
    last: int

    @property
    def model(self) -> Model:
        return LEASE

    @property
    def defines(self) -> list[str]:
        return [f"-DFIRST={self.first}", f"-DGRANTS={self.last}"]


def lease_accepts(folder: Path, events: Sequence[str], names: tuple[str, str] = ("a", "b")) -> bool:
    fields = [_fields(line, names) for line in events]
    numbers = [field["number"] for field in fields if "number" in field]
    if len(numbers) != len(set(numbers)):
        return False
    epochs = [int(field["epoch"]) for field in fields if "epoch" in field]
    grants = [int(field["epoch"]) for field in fields if field["event"] == "granted"]
    first = max(0, min(grants) - 1) if grants else 0
    last = max([first, *epochs])
    if last > _MAX_EPOCHS:
        raise ValueError(f"epoch {last} is too large; give a trace with epochs up to {_MAX_EPOCHS}")
    return accepts(folder, TraceBounds(first, last), [_step(field, names) for field in fields])


def _fields(line: str, names: tuple[str, str]) -> dict[str, str]:
    event, _, rest = line.partition(" ")
    form = _FORMS.get(event)
    if form is None:
        raise ValueError(f"{line!r} is not an event; use one of {', '.join(_FORMS)}")
    match = re.fullmatch(form, rest)
    if match is None:
        raise ValueError(f"{line!r} does not have the form of {event!r}; see the head of this module")
    found = match.groupdict()
    known = {"who": names, "other": names, "process": (*names, _WITNESS)}
    for field, allowed in known.items():
        if field in found and found[field] not in allowed:
            raise ValueError(f"{line!r} names {found[field]!r}; use one of {', '.join(allowed)}")
    if found.get("who") is not None and found.get("who") == found.get("other"):
        raise ValueError(f"{line!r} names {found['who']!r} twice; name both appliances")
    return {"event": event, **found}


def _step(one: dict[str, str], names: tuple[str, str]) -> Step:
    event = one["event"]
    first = (*names, _WITNESS).index(one.get("process") or one["who"])
    second = 0
    if event == "refused":
        holder = re.match(r"(\S+) holds ", one["reason"])
        if holder is not None and holder[1] == names[1 - first]:
            second = 1
        elif one["reason"] == f"{one['who']} is not in sync":
            second = 2
    elif event == "promised":
        second = names.index(one["other"])
    elif "epoch" in one:
        second = int(one["epoch"])
    return ("activated" if event == "active" else event, first, second)
