import asyncio
import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI, Request
from fastapi.routing import iter_route_contexts

from appliance.api.front.problems import ProblemError
from appliance.base.validation_messages import body_refusal, refusal
from appliance.configuration.config_sources import ConfigError, resolve
from appliance.configuration.settings import Settings
from tests.support.command import commands, rosrv
from tests.unit.api.conftest import app  # noqa: F401  the fixture

WRONG: list[Any] = [
    "", "x", "x" * 5000, "\0", "-1", -1, 0, 1.5, 1e300, 1 << 62, True, None, [], ["x"], ["x"] * 2000, [[]],
    {}, {"": 1}, {"x" * 5000: ""}, {"x": {}},
]  # fmt: skip
LIBRARY = re.compile(
    r"Value error|\b[A-Z][a-z]+ should|unable to|Invalid enum|Expected `|Object [mc]|of another form|out of range"
)


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        ("^[0-9a-f]{20}$", "20 hexadecimal digits (0-9, a-f)"),
        (r"^([A-Za-z0-9][A-Za-z0-9.-]{0,62})?$",
         "a name of letters, digits, '.', '-', at most 63, that begins with a letter or digit"),
        (r"^[a-z][a-z0-9_-]{0,30}\Z",
         "a name of small letters, digits, '_', '-', at most 31, that begins with a small letter"),
        ("^[0-9a-f]{64}$", "64 hexadecimal digits (0-9, a-f)"),
        (r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,61}[A-Za-z0-9])?$",
         "a name of letters, digits, '.', '_', '-', at most 63, that begins and ends with a letter or digit"),
        (r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,190}\\.rv$", "a name of letters, digits, '_', '.', '-', at most 191, that"
         " begins with a letter or digit or '_', followed by .rv"),
    ],
)  # fmt: skip
def test_the_form_of_a_name_is_described_in_words(pattern: str, words: str) -> None:
    assert body_refusal(f"Expected `str` matching regex '{pattern}'") == f"must be {words}"
    told = refusal(
        {"type": "string_pattern_mismatch", "loc": (), "msg": "", "ctx": {"pattern": pattern}, "input": "ü"}
    )
    assert told == f"must be {words}, not 'ü'"


def test_the_command_line_explains_valid_values() -> None:
    told = []
    for verb, command in commands():
        for param in command.params:
            kind, name = param.type_descriptor, param.opts[0]
            if not (kind.is_choice or kind.annotation in (int, float)):
                continue
            bounds = kind.parameter_info
            beyond = {"-17": bounds.min, "99999999999": bounds.max}
            for value in ["no-such", *(value for value, bound in beyond.items() if bound is not None)]:
                done = rosrv(*verb.split(), f"{name}={value}" if name.startswith("-") else value)
                told.append(done.stderr)
                assert done.returncode == 2, (verb, value)
                assert value in done.stderr, told[-1]
    assert not [one for one in told if LIBRARY.search(one)]
    assert len(told) > 30


def test_rest_explains_valid_parameters(app: FastAPI) -> None:  # noqa: F811  the fixture
    told = set()
    for dependant in _dependants(app):
        for field in [*dependant.query_params, *dependant.path_params, *dependant.header_params]:
            for value in WRONG:
                told |= {
                    refusal(one) for one in field.validate(value, {}, loc=("query", field.name))[1] or ()
                }
    assert not [one for one in told if LIBRARY.search(one)]
    assert any("'allow', 'deny', 'would deny' or 'ask'" in one for one in told)
    assert len(told) > 50


def test_rest_explains_valid_bodies(app: FastAPI) -> None:  # noqa: F811  the fixture
    told: set[str] = set()
    for dependant in _dependants(app):
        for reads in [one.call for one in dependant.dependencies if hasattr(one.call, "kind")]:
            for name in [*reads.kind.__struct_fields__, "nmae"]:
                for value in WRONG:
                    told |= _said_of(reads, {name: value})
            told |= _said_of(reads, [])
    assert not [one for one in told if LIBRARY.search(one)]
    assert "must be one of 'token', 'kit', not 'x'" in told
    assert not [one for one in told if "one of ," in one or "(?!" in one or len(one) > 300]
    assert "there is no field `nmae`; did you mean name?" in told
    assert len(told) > 50


@pytest.mark.filterwarnings("ignore:__int__ returned non-int")  # ipaddress makes a network of `true`
def test_the_configuration_explains_valid_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    told: set[str] = set()
    for path in _keys(dataclasses.asdict(Settings())):
        for value in WRONG:
            given = value
            for key in reversed(path[1:]):
                given = {key: given}
            try:
                resolve(None, {}, {path[0]: given})
            except ConfigError as error:
                told |= {mistake.text for mistake in error.mistakes}
    assert not [one for one in told if LIBRARY.search(one)]
    assert len(told) > 300


def _dependants(of: FastAPI) -> Iterator[Any]:
    found = [getattr(route.original_route, "dependant", None) for route in iter_route_contexts(of.routes)]
    while found:
        if (dependant := found.pop()) is not None:
            yield dependant
            found += dependant.dependencies


def _said_of(reads: Any, value: Any) -> set[str]:
    async def sent() -> dict[str, Any]:
        return {"type": "http.request", "body": json.dumps(value).encode()}

    headers = [(b"content-type", b"application/json")]
    try:
        asyncio.run(reads(Request({"type": "http", "headers": headers}, sent)))
    except ProblemError as problem:
        return {error.text for error in problem.errors or ()}
    return set()


def _keys(values: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for key, value in values.items():
        yield (key,)
        if isinstance(value, dict):
            yield from ((key, *below) for below in _keys(value))


@pytest.mark.parametrize(
    ("text", "do"),
    [
        ("a: [1\n", "close the bracket, or complete its content"),
        ("a: [", "close the bracket, or complete its content"),
        ("a:\n\tb: 1\n", "indent with spaces, not tabs"),
        ("a: b: c\n", "put a string with `: ` in quotes, and indent the keys of a section equally"),
        ("a: 'x\n", "close the quote"),
        ("- a\nb: 1\n", "indent the lines of a block equally"),
        ("a: @x", "put the string in quotes"),
        ("a: *x", "put the string in quotes"),
    ],
)
def test_invalid_yaml_is_reported_with_a_hint(tmp_path: Path, text: str, do: str) -> None:
    file = tmp_path / "appliance.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=rf"^{re.escape(str(file))}:\d+: is not YAML: .*; {re.escape(do)}$"):
        resolve(file, {}, {})
