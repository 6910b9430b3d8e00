from pathlib import Path

import pytest

from lab.proofs.lease_traces import lease_accepts
from tests.unit.features.standby.simulation import History

TAKEOVER = """\
started witness
started a
started b
refused a no appliance holds the lease for another 0.9 s
granted a 1
active a 1
promised b to a
acknowledged a 1
renewed a 1
passive a
refused b a holds the lease for another 0.4 s
granted b 2
active b 2
removed a by b 2
acknowledged b 2
added a by b 2
acknowledged b 3
passive b
released b 2
granted a 3
active a 3
acknowledged a 4
"""
REBOOT = """\
granted a 1
active a 1
removed b by a 1
acknowledged a 1
rebooted witness
crashed a
started a
started witness
refused b b is not in sync
granted a 2
active a 2
added b by a 2
crashed a
granted b 3
active b 3
"""
PAUSED = """\
granted a 1
active a 1
passive a
active a 1
promised b to a
acknowledged a 1
passive a
granted b 2
active b 2
"""
VALID = {"takeover": TAKEOVER, "reboot": REBOOT, "pause": PAUSED}

TAMPERED = {
    "granted to an appliance that is not in sync": (TAKEOVER, "added a by b 2\n", ""),
    "acknowledged alone without a removal": (
        TAKEOVER,
        "removed a by b 2\nacknowledged b 2\n",
        "crashed a\nacknowledged b 2\nstarted a\n",
    ),
    "active while the other is": (TAKEOVER, "passive a\n", ""),
    "granted before the holder is passive": (TAKEOVER, "passive b\nreleased b 2\n", ""),
    "released by an appliance that does not hold the lease": (TAKEOVER, "released b 2", "released a 2"),
    "granted with the same epoch": (TAKEOVER, "granted b 2\nactive b 2\n", "granted b 1\nactive b 1\n"),
    "renewed for an appliance that does not hold the lease": (TAKEOVER, "renewed a 1", "renewed b 1"),
    "active without a grant": (TAKEOVER, "granted b 2\n", ""),
    "refused in favour of an appliance that does not hold the lease": (
        TAKEOVER,
        "released b 2\n",
        "released b 2\nrefused b a holds the lease for another 0.4 s\n",
    ),
    "a write acknowledged twice": (TAKEOVER, "acknowledged a 4", "acknowledged a 3"),
    "started while it runs": (TAKEOVER, "refused a no", "started a\nrefused a no"),
    "the in-sync set forgotten by a reboot": (
        REBOOT,
        "refused b b is not in sync\ngranted a 2",
        "granted b 2",
    ),
    "active after a crash without an answer": (
        REBOOT,
        "crashed a\nstarted a\n",
        "crashed a\nstarted a\nactive a 1\n",
    ),
    "an answer of a witness that is down": (REBOOT, "started witness\n", ""),
    "active again with an old epoch": (PAUSED, "active b 2\n", "active b 2\nactive a 1\n"),
}


@pytest.mark.parametrize("trace", VALID)
def test_an_execution_is_accepted(tmp_path: Path, trace: str) -> None:
    assert lease_accepts(tmp_path, VALID[trace].splitlines())


@pytest.mark.parametrize("fault", TAMPERED)
def test_a_tampered_execution_is_rejected(tmp_path: Path, fault: str) -> None:
    trace, lines, instead = TAMPERED[fault]
    tampered = trace.replace(lines, instead)
    assert tampered != trace
    assert not lease_accepts(tmp_path, tampered.splitlines())


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("grants a 1", "not an event"),
        ("granted a", "does not have the form"),
        ("granted c 1", "names 'c'; use one of a, b"),
        ("removed a by a 1", "twice"),
        ("granted a 251", "too large"),
    ],
)
def test_a_line_that_is_not_an_event_is_an_error(tmp_path: Path, line: str, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        lease_accepts(tmp_path, [line])


@pytest.mark.parametrize("seed", range(8))
def test_a_history_of_the_product_is_an_execution(seed: int, tmp_path: Path) -> None:
    events: list[str] = []
    History(seed, on_event=events.append).run()
    assert lease_accepts(tmp_path, events)


@pytest.mark.parametrize("seed", range(4))
def test_a_history_with_a_slow_firewall_is_an_execution(seed: int, tmp_path: Path) -> None:
    events: list[str] = []
    History(seed, on_event=events.append, slow=1.1).run()
    assert any(event.startswith("granted") for event in events)
    assert lease_accepts(tmp_path, events)
