import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from appliance.configuration.config_sources import ConfigError, resolve
from appliance.configuration.settings import Settings

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "appliance.yaml"


def mistakes(
    file: Path | None, environment: dict[str, str] | None = None, flags: dict[str, Any] | None = None
) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        resolve(file, environment or {}, flags or {})
    return [str(mistake) for mistake in caught.value.mistakes]


def test_later_sources_override_earlier_ones(file: Path) -> None:
    file.write_text("listen: 127.0.0.1:1\nrosmaster_port: 1\nlimits: {nesting: 7, elements: 8}\n")
    environment = {"ROSRV_ROSMASTER_PORT": "2", "ROSRV_LISTEN": "127.0.0.1:2", "ROSRV_LIMITS__NESTING": "9"}
    settings = resolve(file, environment, {"listen": "127.0.0.1:3", "isolation": None})
    assert settings.listen == "127.0.0.1:3"
    assert settings.rosmaster_port == 2
    assert (settings.limits.nesting, settings.limits.elements) == (9, 8)
    assert settings.isolation == "netns"


def test_all_mistakes_are_reported_with_their_positions(file: Path) -> None:
    file.write_text(
        "listn: 0.0.0.0:1\nlimits:\n  nesting: deep\n  bodybytes: 1\naudit:\n  durability: sometimes\n"
    )
    found = mistakes(file, {"ROSRV_RELAYS": "many"}, {"isolation": "vm"})
    assert f"{file}:1: unknown key listn: did you mean listen?" in found
    assert f"{file}:4: unknown key limits.bodybytes: did you mean body_bytes?" in found
    assert any(one.startswith(f"{file}:3: limits.nesting: ") and "'deep'" in one for one in found)
    assert any(
        one.startswith(f"{file}:6: audit.durability: ") and "'strict' or 'batched'" in one for one in found
    )
    assert any(one.startswith("ROSRV_RELAYS: relays: ") for one in found)
    assert any(one.startswith("--isolation: must be 'container'") and "'vm'" in one for one in found)
    assert len(found) == 6


def test_a_key_in_the_wrong_section_names_the_right_one(file: Path) -> None:
    file.write_text("queue_messages: 10\n")
    assert mistakes(file) == [f"{file}:1: unknown key queue_messages: did you mean relay.queue_messages?"]


def test_a_wrong_entry_of_a_list_has_its_line(file: Path) -> None:
    file.write_text(
        "advertise:\n- {network: 10.0.0.0/8, address: 10.0.0.1}\n"
        "- network: 10.0.0.0/99\n  address: 10.0.0.1\n  adress: 1\n"
    )
    found = mistakes(file)
    assert [one.split(": ")[0] for one in found] == [f"{file}:3", f"{file}:5"]
    assert found[1].endswith("did you mean address?")


@pytest.mark.parametrize(
    "value", ["perhaps", 5.5, -1, None, [1], {"a": 1}, ["x"], "", 10**30, float("nan"), "5 parsecs"]
)
def test_messages_about_values_are_our_own(value: Any) -> None:
    settings = asdict(Settings())
    given = [{key: value} for key in settings]
    given += [
        {key: {below: value}}
        for key, section in settings.items()
        if isinstance(section, dict)
        for below in section
    ]
    told = []
    for flags in given:
        with suppress(ConfigError):
            resolve(None, {}, flags)
            continue
        told += [mistake.partition(", not ")[0] for mistake in mistakes(None, {}, flags)]
    assert [
        one
        for one in told
        if re.search(r"input|valid|instance|class|\bpars(e|ing)\b|integer|boolean|dictionary", one)
    ] == []


def test_monitors_to_enable_as_a_list(file: Path) -> None:
    file.write_text("enable: [speedLimit, zone]\n")
    assert resolve(file, {}, {}).enable == "speedLimit,zone"
    file.write_text("enable:\n  - speedLimit\n  - {zone: 1}\n")
    [mistake] = mistakes(file)
    assert mistake.startswith(f"{file}:1: enable: must be ")
    file.write_text("enable: [speedLimit, all]\n")
    assert mistakes(file) == [
        f"{file}:1: enable: all applies to all monitors, so it cannot be combined with names: give one"
    ]


def test_a_key_given_twice_is_a_mistake(file: Path) -> None:
    file.write_text("relays: 1\nlisten: 127.0.0.1:1\nrelays: 1\n")
    assert mistakes(file) == [f"{file}:3: relays is given twice"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: [1\n", ":2: is not YAML"),
        ("- 1\n", ":1: must have lines of the form"),
        ("listen: !!python/object/apply:os.system [true]\n", "is not YAML"),
        ("a: &x [*x]\n", "refers to itself"),
        ("1: 2\n", "unknown key 1"),
        ("? [1, 2]\n: 3\n", "is not YAML"),
        ("limits: 5\n", ":1: limits: "),
        ("limits:\n", ":1: limits: "),
        ("listen: \x00\n", "is not YAML"),
        ("[" * 3000, "nested too deep"),
    ],
)
def test_an_unreadable_file_is_an_error(file: Path, text: str, expected: str) -> None:
    file.write_text(text)
    assert any(expected in mistake for mistake in mistakes(file))


def test_a_named_file_must_exist(tmp_path: Path) -> None:
    assert "cannot be read: No such file" in mistakes(tmp_path / "missing.yaml")[0]
    assert (
        "cannot be read: No such file" in mistakes(None, {"ROSRV_CONFIG": str(tmp_path / "missing.yaml")})[0]
    )


def test_a_file_in_the_working_directory_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert resolve(None, {}, {}).rosmaster_port == Settings().rosmaster_port
    (tmp_path / "appliance.yaml").write_text("rosmaster_port: 5\n")
    assert resolve(None, {}, {}).rosmaster_port == 5


def test_relative_paths_depend_on_their_source(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    assert resolve(None, {}, {}).hosts == Path("/ipsec/hosts.yaml")
    file.write_text("policy: policies/a.ini\nstate: /srv/state\n")
    settings = resolve(file, {}, {})
    assert settings.policy == file.parent / "policies/a.ini"
    assert settings.state == Path("/srv/state")
    assert settings.hosts == file.parent / "ipsec/hosts.yaml"
    assert resolve(file, {}, {"policy": Path("b.ini")}).policy == Path("/b.ini")


def test_a_removed_section_says_why(tmp_path: Path) -> None:
    file = tmp_path / "appliance.yaml"
    file.write_text("availability: {wait: none}\n")
    [found] = mistakes(file)
    assert found.startswith(f"{file}:1: availability is not a section any more: answers")
    assert found.endswith("remove the section")


def test_an_unknown_variable_is_a_mistake() -> None:
    assert mistakes(None, {"ROSRV_LISTN": "x"}) == ["ROSRV_LISTN: unknown key listn: did you mean listen?"]
    assert "ROSRV_LISTEN__PORT: " in mistakes(None, {"ROSRV_LISTEN__PORT": "1"})[0]


def test_variables_of_other_programs_are_ignored() -> None:
    environment = {
        "ROSRV_SERVICE_HOST": "10.0.0.1",
        "ROSRV_SERVICE_PORT_MASTER": "11311",
        "ROSRV_NAME": "/robot/rosrv",
        "ROSRV_PORT": "tcp://10.0.0.1:11311",
        "ROSRV_PORT_11311_TCP_ADDR": "10.0.0.1",
        "ROSRV_TOKEN": "secret",
    }
    assert resolve(None, environment, {}) == resolve(None, {}, {})


def leaves(settings: "DataclassInstance", *path: str) -> Iterator[tuple[str, object]]:
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value) and not isinstance(value, type):
            yield from leaves(value, *path, field.name)
        else:
            yield "ROSRV_" + "__".join((*path, field.name)).upper(), value


def test_each_value_can_be_given_in_the_environment() -> None:
    """An address that a message proposes and `null` are given in the same way."""
    default = resolve(None, {}, {})
    given = dict(leaves(default))
    assert len(given) > 100
    texts = {name: "null" if value is None else value for name, value in given.items()}
    plain = {name: str(value) for name, value in texts.items() if isinstance(value, str | int | float)}
    assert resolve(None, plain | {"ROSRV_NAME": default.name}, {}) == default
    named = resolve(None, {"ROSRV_NAME": "lift-7", "ROSRV_LISTEN": "[::]:11311"}, {})
    assert (named.name, named.listen) == ("lift-7", "[::]:11311")


def test_a_list_in_the_environment_is_yaml() -> None:
    value = "[{network: 10.0.0.0/8, address: 10.1.1.1}]"
    assert str(resolve(None, {"ROSRV_ADVERTISE": value}, {}).advertise[0].address) == "10.1.1.1"
    assert mistakes(None, {"ROSRV_ADVERTISE": "[{"})[0].startswith("ROSRV_ADVERTISE: is not YAML")


def test_a_mistake_about_two_keys_names_one_that_was_set() -> None:
    with pytest.raises(ConfigError) as caught:
        resolve(None, {}, {"policy": Path("/a.ini"), "mediation": "monitored"})
    assert str(caught.value) == "--mediation: monitored needs relaying: monitored (--relay monitored)"


def test_the_variable_of_a_flag_with_another_key() -> None:
    assert (
        resolve(None, {"ROSRV_RELAY": "monitored", "ROSRV_MEDIATION": "monitored"}, {}).relaying
        == "monitored"
    )
    with pytest.raises(ConfigError, match=r"ROSRV_RELAY: relaying: .*'some'"):
        resolve(None, {"ROSRV_RELAY": "some"}, {})
    key, value = next(iter(asdict(Settings().relay).items()))
    as_table = resolve(None, {"ROSRV_RELAY": f"{{{key}: {value}}}"}, {})
    as_key = resolve(None, {f"ROSRV_RELAY__{key.upper()}": str(value)}, {})
    assert as_table == as_key == resolve(None, {}, {})
