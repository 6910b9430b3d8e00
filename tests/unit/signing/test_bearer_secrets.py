from typing import NamedTuple

import pytest

from appliance.signing.bearer_secrets import SecretForm, hash_of, is_hash_of

SECRET = "A" * 43
# Made with `sha256sum`, not with the tested code.
HASH = bytes.fromhex("0f007385b6f9d4b7eeb2748605afe1a984a0a3bfa3f014d09e2a784ce9e5cd1a")
ID = "5c0f3d2b9a11"
FORMS = [("rosrv_", "_"), ("rosrv-read_", "_"), ("rosrv-enrol_", "_"), ("", ".")]


class Row(NamedTuple):
    hash: bytes


def test_the_hash_of_stored_secrets_never_changes() -> None:
    assert hash_of(SECRET) == HASH
    assert is_hash_of(SECRET, HASH)
    assert not is_hash_of(SECRET[:-1] + "B", HASH)
    assert not is_hash_of("", HASH) and not is_hash_of(SECRET, b"")


@pytest.mark.parametrize(("prefix", "separator"), FORMS)
def test_only_the_whole_text_finds_its_row(prefix: str, separator: str) -> None:
    form = SecretForm(prefix, separator)
    number, secret, text = form.make()
    rows = {number: Row(hash_of(secret)), ID: Row(HASH), "": Row(hash_of(""))}
    assert form.parse(text) == (number, secret)
    assert form.find(text, rows) is rows[number]
    assert form.find(f"{prefix}{ID}{separator}{SECRET}", rows) is rows[ID]
    other = "_" if separator == "." else "."
    wrong = [
        "", text[:-1], text + "A", f" {text}", f"{text}\n", f"x{text}", text.replace(separator, other),
        f"{prefix}{ID}{separator}{secret}", f"{prefix}{number}{separator}{SECRET}",
        f"{prefix}{'0' * 12}{separator}{secret}", f"{prefix}{number.upper()}é{separator}{secret}",
    ]  # fmt: skip
    assert [one for one in wrong if form.find(one, rows)] == []
    assert [one for one in (text[:-1], text + "A", f"{text}\n") if form.parse(one)] == []


def test_a_text_of_one_form_is_none_of_another() -> None:
    forms = [SecretForm(*form) for form in FORMS]
    for form in forms:
        text = form.make()[2]
        assert [one for one in forms if one.parse(text) is not None] == [form]
