"""Faults of the sinks, which the histories of `sink_history.py` must find. Each replaces a part of a function."""

import inspect
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from appliance.master import rosmaster
from appliance.master.endpoints.relay_control import RelayControl, RelayOutbox
from appliance.master.graph.registry import Registry
from appliance.master.reconcile.sinks import ProxyEndpoints, StoredGraph
from appliance.master.reconcile.subscribers import Subscribers
from appliance.master.rosmaster import MasterRegistrations
from tests.support.examples import sample
from tests.unit.master.reconcile.sink_history import history, live
from tests.unit.transcripts import transcripts

pytestmark = pytest.mark.timeout(60)
_SEEDS = 500


class Fault(NamedTuple):
    """The replacement of `text`, which occurs once in the function `name` of a class or module, with `wrong`."""

    place: Any
    name: str
    text: str
    wrong: str


PLACES: dict[str, Any] = {
    one.__name__.rpartition(".")[2]: one
    for one in (
        rosmaster, MasterRegistrations, ProxyEndpoints, Registry, RelayControl, RelayOutbox, StoredGraph, Subscribers,
    )
}  # fmt: skip


def faults() -> Iterator[tuple[str, Fault]]:
    """Read `sink_faults.txt`: below each function of a class or module, `what it does: a text => what replaces it`."""
    for place, lines in transcripts(Path(__file__).with_name("sink_faults.txt")).items():
        name = ""
        for line in lines:
            title, told, change = line.strip().partition(": ")
            if told:
                text, _, wrong = change.partition(" =>")
                yield title, Fault(PLACES[place], name, text, wrong.strip())
            else:
                name = line


FAULTS = dict(faults())


def faulty(fault: Fault) -> Any:
    function = inspect.unwrap(getattr(fault.place, fault.name))
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(fault.text) == 1, f"{fault.name} has {fault.text!r} {source.count(fault.text)} times"
    source = source.replace(fault.text, fault.wrong).replace(
        "super()", f"super({fault.place.__name__}, self)"
    )
    names: dict[str, Any] = {}
    exec(compile(source, fault.name, "exec"), function.__globals__, names)  # noqa: S102  a fault of our own source
    return names[fault.name]


def test_each_fault_has_its_place() -> None:
    assert all(faulty(fault) for fault in FAULTS.values())


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", sample([*FAULTS], 11))
def test_each_fault_of_a_sink_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fault = FAULTS[name]
    monkeypatch.setattr(fault.place, fault.name, faulty(fault))

    with pytest.raises((AssertionError, KeyError)):
        for seed in range(_SEEDS):
            live(history(seed))
