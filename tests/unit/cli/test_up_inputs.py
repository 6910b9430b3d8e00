from dataclasses import replace
from pathlib import Path

import pytest

from appliance.cli.up_inputs import read_inputs, read_node_ports
from appliance.configuration.settings import Settings
from appliance.policy.policy import DEFAULT_PORTS
from appliance.store.state_file import RevisionRow, StateStore
from appliance.supervisor.errors import StartError
from tests.support.control_parts import OPEN
from tests.support.engines import InlineDatabase
from tests.support.site_key import LINE

KEPT = OPEN + "[Ports]\nrange = 19001-20000\n"
NEW = OPEN + "[Ports]\nrange = 21001-22000\n"
DENIED = "cases:\n  - {host: 10.0.0.5, node: /n, publish: /t, expect: deny}\n"


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    (tmp_path / "control").mkdir()
    (tmp_path / "policy.ini").write_text(NEW)
    return Settings(state=tmp_path, policy=tmp_path / "policy.ini", isolation="none", api="off")


def store_revision(settings: Settings, who: str) -> None:
    store = StateStore(settings.state / "control", failed=pytest.fail, kind=InlineDatabase)
    store.save_revision(RevisionRow(1, KEPT, str(settings.policy), 0.0, who, ""))
    store.close()


@pytest.mark.parametrize(
    ("who", "witness", "files", "first"),
    [
        ("disk", None, (NEW, ""), 21001),
        ("disk", None, (NEW, DENIED), 19001),
        ("disk", None, ("[Nonsense]\n", ""), 19001),
        ("alice", None, (NEW, ""), 19001),
        ("disk", "127.0.0.1", (NEW, ""), 19001),
    ],
)
def test_the_ports_are_those_of_the_policy_that_comes_into_force(
    settings: Settings, who: str, witness: str | None, files: tuple[str, str], first: int
) -> None:
    store_revision(settings, who)
    policy, cases = files
    settings.policy.write_text(policy)
    if cases:
        settings.policy.with_name("policy.ini.tests.yaml").write_text(cases)
    assert read_node_ports(settings, witness).start == first


@pytest.mark.parametrize(("content", "keys"), [(b"\xff\xfe", ()), (None, ()), (NEW.encode(), (LINE,))])
def test_a_first_start_is_refused_without_a_usable_policy(
    settings: Settings, content: bytes | None, keys: tuple[str, ...]
) -> None:
    settings = replace(settings, site_keys=[*keys])
    settings.policy.unlink()
    if content is None:
        settings.policy.mkdir()
    else:
        settings.policy.write_bytes(content)
    with pytest.raises(StartError, match=r"policy\.ini.*(UTF-8|it is a folder|signature)"):
        read_node_ports(settings)
    store_revision(settings, "disk")
    assert read_node_ports(settings).start == (DEFAULT_PORTS.start if keys else 19001)


def test_a_first_start_needs_a_valid_policy(settings: Settings) -> None:
    settings.policy.with_name("policy.ini.tests.yaml").write_text(DENIED)
    with pytest.raises(StartError, match=r"policy\.ini\.tests\.yaml:2:"):
        read_node_ports(settings)
    settings.policy.unlink()
    with pytest.raises(StartError, match=r"cannot be read.*nothing was started"):
        read_inputs(settings)


def test_an_unknown_state_is_left_to_rvmaster(settings: Settings) -> None:
    (settings.state / "control" / "state.db").write_bytes(b"damaged, or not readable")
    settings.policy.write_text("[Nonsense]\n")
    assert read_node_ports(settings) == DEFAULT_PORTS
