from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.signing.bearer_secrets import hash_of
from appliance.signing.request_signing import (
    BadProofError,
    is_signed,
    keys_of,
    parse_proof,
    proof_of,
    reading_id,
    reading_key,
    statement,
)

# Made with OpenSSL 3 (`openssl dgst -hmac`, `openssl pkeyutl -sign -rawin`), not with the tested code.
TOKEN = "rosrv_5c0f3d2b9a11_AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA"  # noqa: S105  an example
READING = "rosrv-read_5c0f3d2b9a11_AwwrT78sKKQ79xXtfC8OnQf5VEjcIKUbLcfJ4UooWjU"
VERIFYING = "fe8e3dde8844937a82f36c38d3ffbe4d3deb3ebaa84abe88709aa8d246e0463f"
STATED = (
    b'rosrv order 1\n60.000.abc.def\nPOST\n/v1/policy?confirm_within=300\n"4"\ntext/plain\n'
    b"51aaef259ecb5c123086d80748a4486b2a9e1526a01d62d424e3d87ca4859f8c"
)
PROOF = (
    "60.000.abc.def VLxIHlPB3U8nnpX9SQTeWaqvI29oCelLXuGOQJt-AyJ-A7UnImBLhFTGmGH7vlRYQd8LzkDnnuweZeoe6FZICw"
)
REQUEST = {
    "method": "POST",
    "target": "/v1/policy?confirm_within=300",
    "if_match": '"4"',
    "content_type": "text/plain",
    "body": b"[Nodes]\n",
}


def stated(challenge: str = "60.000.abc.def", **parts: object) -> bytes:
    return statement(challenge, **{**REQUEST, **parts})  # type: ignore[arg-type]  # each part is what it is there


def test_the_vectors() -> None:
    assert reading_key(TOKEN) == READING
    assert reading_id(READING) == "5c0f3d2b9a11"
    assert keys_of(TOKEN).verifying.hex() == VERIFYING
    assert keys_of(TOKEN).reading == hash_of(READING)
    assert stated() == STATED
    assert proof_of(TOKEN, "60.000.abc.def", STATED) == PROOF
    challenge, signature = parse_proof(PROOF)
    assert is_signed(bytes.fromhex(VERIFYING), stated(challenge), signature)


@pytest.mark.parametrize(
    "parts",
    [
        {"method": "PUT"}, {"target": "/v1/policy"}, {"target": "/v1/policy?confirm_within=301"},
        {"if_match": "*"}, {"if_match": ""}, {"content_type": "application/json"}, {"body": b"[Nodes]"},
        {"body": b""}, {"challenge": "60.000.abc.deg"},
    ],
)  # fmt: skip
def test_a_proof_is_of_one_request(parts: dict[str, object]) -> None:
    _challenge, signature = parse_proof(PROOF)
    assert not is_signed(bytes.fromhex(VERIFYING), stated(**parts), signature)  # type: ignore[arg-type]  # as above


def test_neither_the_reading_key_nor_the_saved_key_is_the_token() -> None:
    other = "rosrv_5c0f3d2b9a12_AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA"
    secret = TOKEN.rpartition("_")[2]
    assert secret not in reading_key(TOKEN)
    assert reading_key(TOKEN).rpartition("_")[2] != reading_key(other).rpartition("_")[2]
    assert keys_of(TOKEN) != keys_of(other)


@pytest.mark.parametrize("part", ["method", "target", "if_match", "content_type"])
@pytest.mark.parametrize("text", ["a\nb", "a\r", "\x00", "é", "a\x7f"])
def test_no_part_spills_into_another(part: str, text: str) -> None:
    with pytest.raises(BadProofError, match="character"):
        stated(**{part: text})


@given(
    st.lists(st.text(st.characters(min_codepoint=32, max_codepoint=126)), min_size=5, max_size=5),
    st.lists(st.text(st.characters(min_codepoint=32, max_codepoint=126)), min_size=5, max_size=5),
    st.binary(max_size=20),
)
def test_different_requests_have_different_statements(one: list[str], two: list[str], body: bytes) -> None:
    def text(parts: list[str]) -> bytes:
        challenge, method, target, match, kind = parts
        return statement(
            challenge, method=method, target=target, if_match=match, content_type=kind, body=body
        )

    assert (text(one) == text(two)) == (one == two)


@pytest.mark.parametrize(
    "header", ["", "x", "a b", f"{'c' * 201} {'A' * 86}", f"c {'A' * 85}", f"c {'A' * 87}", f"c\n {'A' * 86}"]
)
def test_a_malformed_proof_is_rejected(header: str) -> None:
    with pytest.raises(BadProofError, match="CHALLENGE SIGNATURE"):
        parse_proof(header)


def test_the_page_shows_what_a_script_does(monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "rest.md").read_text()
    [example] = [block.partition("```")[0] for block in page.split("```python\n")[1:]]
    monkeypatch.setenv("ROSRV_TOKEN", TOKEN)
    names: dict[str, Any] = {}
    exec(example, names)  # noqa: S102  of our own page
    assert names["reading_key"] == READING
    assert names["proof"]("60.000.abc.def", *REQUEST.values()) == PROOF
