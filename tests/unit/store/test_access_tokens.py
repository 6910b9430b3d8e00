import pytest

from appliance.store.access_tokens import BadTokenNameError, is_secret, make_token, parse_token


def test_only_its_own_secret_proves_a_token() -> None:
    row, text = make_token("alice", "viewer", now=1000.0, seconds=60)
    parsed = parse_token(text)
    assert parsed is not None
    assert parsed[0] == row.id
    assert is_secret(parsed[1], row.salt, row.hash)
    other = parse_token(make_token("bob", "viewer", now=1000.0, seconds=60)[1])
    assert other is not None
    assert not is_secret(other[1], row.salt, row.hash)
    assert not is_secret(parsed[1][:-1] + ("A" if parsed[1][-1] != "A" else "B"), row.salt, row.hash)
    assert not is_secret(row.hash.hex()[:43], row.salt, row.hash)


def test_the_stored_row_does_not_have_the_secret() -> None:
    row, text = make_token("alice", "viewer", now=1000.0, seconds=60)
    assert text.split("_", 2)[2] not in repr(row)
    again, _text = make_token("alice", "viewer", now=1000.0, seconds=60)
    assert (row.salt, row.hash, row.id) != (again.salt, again.hash, again.id)


@pytest.mark.parametrize(
    "text", ["", "rosrv_", "rosrv_0123456789ab_", "rosrv_0123456789AB_" + "a" * 43, "rosrv_0123456789ab_" + "a" * 44,
             "rosrv_0123456789ab_" + "a" * 42 + "é", " rosrv_0123456789ab_" + "a" * 43],
)  # fmt: skip
def test_an_invalid_token_is_none(text: str) -> None:
    assert parse_token(text) is None


@pytest.mark.parametrize("name", ["", "disk", "operator", "a b", "-a", "a" * 64, "a\n", "é", "../x"])
def test_misleading_names_are_refused(name: str) -> None:
    with pytest.raises(BadTokenNameError, match="is not a valid token name"):
        make_token(name, "viewer", now=0.0, seconds=1)
