import re
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
from fastapi import FastAPI

from appliance.api.front.request_gate import PUBLIC
from appliance.api.routes.contract import EXAMPLES
from appliance.api.routes.contract_page import PATH
from tests.support.asgi import requested
from tests.support.rows import require_rows
from tests.system.test_generated_client import CALLS, ELSEWHERE, REFUSED
from tests.unit.api.routes.test_operation_routes import BY_HAND

EXAMPLE_FILE = "appliance/api/routes/examples.json"
_OF_CHANGES = {"/v1/policy", "/v1/hosts", "/v1/hosts/{name}", "/v1/monitors", "/v1/monitors/{name}"}
APPLIANCE = Path(__file__).parents[4] / "appliance"
_UNITS = ("seconds", "days")
_IN_NAME = {*_UNITS, "us", "second"}
_IN_WORDS = (
    *_UNITS, "microseconds", "milliseconds", "nanoseconds", "RFC 3339", "unit", "until the certificate ends",
)  # fmt: skip


@pytest.fixture(scope="module")
def contract(app: FastAPI) -> dict[str, Any]:
    return app.openapi()


def _kinds(schema: dict[str, Any]) -> set[str]:
    kind = schema.get("type", [])
    kinds = {kind} if isinstance(kind, str) else set(kind)
    return kinds.union(*map(_kinds, schema.get("anyOf", ())))


def _words(schema: dict[str, Any]) -> str:
    return " ".join([schema.get("description", ""), *map(_words, schema.get("anyOf", ()))])


def test_a_wrong_method_lists_the_valid_ones(app: FastAPI, contract: dict[str, Any]) -> None:
    paths = [*(path for path in contract["paths"] if "{" not in path), "/v1/tokens/{name}"]
    answers = [requested(app, "TRACE", path.format(name="mallory")) for path in paths]
    found = [(answer.status_code, answer.headers["allow"].split(", ")) for answer in answers]
    offered = [[method.upper() for method in contract["paths"][path]] for path in paths]
    assert found == [(405, sorted([*own, *["HEAD"] * ("GET" in own)])) for own in offered]
    assert all(answer.json()["detail"].endswith(f"; it has: {answer.headers['allow']}") for answer in answers)


def _unbounded(
    schema: dict[str, Any], schemas: dict[str, Any], where: str, seen: frozenset[str] = frozenset()
) -> list[str]:
    """Return the places of numbers and texts without a maximum."""
    name = schema.get("$ref", "").rpartition("/")[2]
    if name:
        return [] if name in seen else _unbounded(schemas[name], schemas, where, seen | {name})
    found = (
        [where]
        if schema.get("type") in ("integer", "number", "string")
        and not {"maximum", "exclusiveMaximum", "maxLength", "pattern", "enum", "const"} & {*schema}
        else []
    )
    parts = [(where, one) for key in ("anyOf", "oneOf", "allOf") for one in schema.get(key, ())]
    parts += [(f"{where}.{key}", one) for key, one in schema.get("properties", {}).items()]
    parts += [
        (f"{where}[]", schema[key])
        for key in ("items", "additionalProperties")
        if isinstance(schema.get(key), dict)
    ]
    return found + [place for inner, one in parts for place in _unbounded(one, schemas, inner, seen)]


def test_a_value_of_a_client_has_a_maximum(contract: dict[str, Any]) -> None:
    """Numbers of more than 64 bits cannot be sent to control, so without a maximum they were a defect (500); without
    one for times, a change could wait for years to be confirmed."""
    schemas, found, seen = contract["components"]["schemas"], [], 0
    for path, methods in contract["paths"].items():
        for method, operation in methods.items():
            sent = {one["name"]: one["schema"] for one in operation.get("parameters", ())}
            content = operation.get("requestBody", {}).get("content", {})
            sent |= {kind: body["schema"] for kind, body in content.items() if "schema" in body}
            sent.pop("text/plain", None)  # the field `text` of the JSON
            seen += len(sent)
            for name, schema in sent.items():
                found += _unbounded(schema, schemas, f"{method.upper()} {path} {name}")
    assert seen > 100
    # Values of monitors and guards: the text of a specification has their ranges.
    assert [place for place in found if not re.search(r"json\.(given(\[\])?|values)\[\]$", place)] == []


@pytest.mark.complete
def test_times_have_units(contract: dict[str, Any]) -> None:
    without, seen = [], 0
    for kind, schema in contract["components"]["schemas"].items():
        for name, of in schema.get("properties", {}).items():
            is_time = "number" in _kinds(of) or name in ("time", "since", "until") or name.endswith("_time")
            if not is_time or _kinds(of) <= {"object", "array", "boolean"}:
                continue
            seen += 1
            if _IN_NAME.isdisjoint(name.split("_")) and not any(word in _words(of) for word in _IN_WORDS):
                without.append(f"{kind}.{name}: give the unit in its doc, such as doc('… in seconds')")
    assert not without, "\n".join(without)
    assert seen > 30


def _is_described(field: dict[str, Any]) -> bool:
    return "description" in field or any(map(_is_described, field.get("anyOf", ())))


@pytest.mark.complete
def test_every_field_is_described(contract: dict[str, Any]) -> None:
    fields = {
        (kind, name): field
        for kind, schema in contract["components"]["schemas"].items()
        for name, field in schema.get("properties", {}).items()
    }
    bare = [
        f"{kind}.{name}: describe it with doc(…)"
        for (kind, name), field in fields.items()
        if not _is_described(field) and "$ref" not in field
    ]
    assert not bare, "\n".join(bare)
    assert len(fields) > 500


def test_every_operation_has_a_summary_its_token_and_problems(contract: dict[str, Any]) -> None:
    operations = {
        f"{method.upper()} {path}": one
        for path, row in contract["paths"].items()
        for method, one in row.items()
    }
    own = {name for name in BY_HAND[None] if " /v1/openapi." in name}
    assert {name for name, one in operations.items() if "security" not in one} == BY_HAND[None] - own
    assert len({operation["operationId"] for operation in operations.values()}) == len(operations)
    for name, one in operations.items():
        assert one["summary"] and one["description"], name
        for status, response in one["responses"].items():
            if status >= "400":  # 400: of the server itself, which has no request yet, and so no application
                media = "text/plain" if status == "400" else "application/problem+json"
                assert list(response["content"]) == [media], (name, status)


def test_every_json_answer_has_an_etag(contract: dict[str, Any]) -> None:
    for path, operations in contract["paths"].items():
        if "get" not in operations:
            continue
        responses = operations["get"]["responses"]
        good = responses["200"]
        if "application/json" not in good.get("content", {}):
            assert "304" not in responses, path
            continue
        said = good["headers"]["ETag"]["description"]
        assert ("If-None-Match" in said) == ("304" in responses), path
        assert ("If-Match" in said) == (path in _OF_CHANGES), path


def _unexemplified(name: str, operation: dict[str, Any], kinds: dict[str, Any]) -> list[str]:
    def without(content: dict[str, Any]) -> list[str]:
        return [
            media
            for media, one in content.items()
            if one["schema"].get("format") != "binary"
            and "example" not in one
            and "examples" not in kinds.get(one["schema"].get("$ref", "").rpartition("/")[2], {})
        ]

    parts = {
        one["name"]: "examples" in one["schema"] or "examples" in one
        for one in operation.get("parameters", ())
        if one["in"] == "path"
    }
    missing = [part for part, there in parts.items() if not there]
    missing += without(operation.get("requestBody", {}).get("content", {}))
    for status, response in operation["responses"].items():
        missing += without(response.get("content", {})) if status.startswith("2") else []
    return [f"{name}: {one}" for one in missing]


@pytest.mark.complete
def test_every_operation_has_examples(contract: dict[str, Any]) -> None:
    kinds = contract["components"]["schemas"]
    operations = {
        f"{method} {path}": one for path, row in contract["paths"].items() for method, one in row.items()
    }
    missing = [line for name, one in operations.items() for line in _unexemplified(name, one, kinds)]
    assert not missing, "\n".join([f"add an example to {EXAMPLE_FILE}:", *missing])
    assert set(EXAMPLES) <= {*kinds, *(operation["operationId"] for operation in operations.values())}
    assert len(operations) > 60


@pytest.mark.complete
def test_examples_match_their_schemas(contract: dict[str, Any]) -> None:
    kinds = contract["components"]["schemas"]
    told = [
        ({"$ref": f"#/components/schemas/{kind}"}, one)
        for kind, schema in kinds.items()
        for one in schema.get("examples", ())
    ]
    for row in contract["paths"].values():
        for operation in row.values():
            for response in (operation.get("requestBody", {}), *operation["responses"].values()):
                told += [
                    (one["schema"], one["example"])
                    for one in response.get("content", {}).values()
                    if "example" in one
                ]
    for schema, value in told:
        validator = jsonschema_rs.Draft202012Validator(schema | {"components": contract["components"]})
        wrong = [str(error.message) for error in validator.iter_errors(value)]
        assert not wrong, f"{schema}: correct its example in {EXAMPLE_FILE}: {'; '.join(wrong)}"
    assert len(told) > len(EXAMPLES)


def _absent(written: Any, shown: Any, where: str) -> list[str]:
    """Return the fields of an example that its kind lacks: the contract leaves them out."""
    if isinstance(written, dict) and isinstance(shown, dict):
        absent = [f"{where}.{name}" for name in written.keys() - shown.keys()]
        return absent + [
            line
            for name in written.keys() & shown.keys()
            for line in _absent(written[name], shown[name], f"{where}.{name}")
        ]
    if isinstance(written, list) and isinstance(shown, list):
        return [
            line for one, other in zip(written, shown, strict=True) for line in _absent(one, other, where)
        ]
    return []


@pytest.mark.complete
def test_examples_have_only_fields_of_their_kinds(contract: dict[str, Any]) -> None:
    shown = {
        kind: schema["examples"][0]
        for kind, schema in contract["components"]["schemas"].items()
        if "examples" in schema
    }
    absent = [
        line for kind, one in EXAMPLES.items() if kind in shown for line in _absent(one, shown[kind], kind)
    ]
    assert not absent, "\n".join([f"{EXAMPLE_FILE}: remove the fields that do not exist:", *absent])
    assert {"token_by", "last_seen_utc"} <= shown["Hosts"]["hosts"][0].keys()


def test_the_console_reads_fields_of_the_contract(contract: dict[str, Any]) -> None:
    schemas = contract["components"]["schemas"].values()
    fields = {name for schema in schemas for name in schema.get("properties", {})}
    scripts = (
        path
        for path in APPLIANCE.glob("**/console/**/*.js")
        if "vendor" not in path.relative_to(APPLIANCE).parts
    )
    texts = [(APPLIANCE / path).read_text() for path in scripts if "vendor" not in path.parts]
    own = {
        name for text in texts for name in re.findall(r"\b([a-z]\w*)\b(?=\s*[:,}=])(?<!\.)", _unread(text))
    }
    read = {
        name
        for text in texts
        for name in re.findall(r"\b(?:row|one|body)\??\.([a-z][a-z0-9_]*)\b(?!\()", text)
    }
    assert {"would_drop", "shadow", "held"} <= read
    assert sorted(read - fields - own - {"length"}) == []


def _unread(text: str) -> str:
    return re.sub(r"\??\.[a-z]\w*", "", text)


def test_the_page_has_each_call(app: FastAPI, contract: dict[str, Any]) -> None:
    lost = requested(app, "GET", "/v1/nothing")
    assert lost.status_code == 404
    assert '</v1/openapi.html>; rel="service-doc"' in lost.headers["link"]
    page = requested(app, "GET", "/v1/openapi.html")
    assert "<script" not in page.text
    assert PATH in PUBLIC
    shown = re.findall(r"<h3><a href=\S+<code>(\w+) (\S+)</code>", page.text)
    calls = [(method.upper(), path) for path, some in contract["paths"].items() for method in some]
    assert sorted(shown) == sorted(calls)


@pytest.mark.complete
def test_the_nightly_client_calls_every_operation(contract: dict[str, Any]) -> None:
    operations = {one["operationId"] for path in contract["paths"].values() for one in path.values()}
    called = CALLS.keys() | REFUSED.keys() | ELSEWHERE
    require_rows(operations, called, "CALLS of tests/system/test_generated_client.py")
