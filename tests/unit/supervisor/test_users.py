import os
import pwd

import pytest

from appliance.supervisor.users import NUMERIC_IDS, account_of


def test_without_a_user_of_that_name_the_numeric_id_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)

    def unknown(name: str) -> pwd.struct_passwd:
        raise KeyError(name)

    monkeypatch.setattr(pwd, "getpwnam", unknown)
    accounts = {user: account_of(user) for user in NUMERIC_IDS}
    assert {user: (account.uid, account.gid) for user, account in accounts.items()} == {
        "rosrv": (61011, 61011),
        "rosmaster": (61012, 61012),
        "rosrv-relay": (61013, 61013),
        "rosrv-api": (61014, 61014),
        "rosrv-signer": (61015, 61015),
        "rosrv-ipsec": (61016, 61016),
        "rosrv-syslog": (61017, 61017),
        "rosrv-rosout": (61018, 61018),
        "rosrv-recorder": (61019, 61019),
        "rosrv-compiler": (61020, 61020),
        "rosrv-lease": (61021, 61021),
        "rosrv-bundles": (61022, 61022),
        "rosrv-fleet": (61023, 61023),
        "rosrv-doors": (61024, 61024),
        "rosrv-sso": (61025, 61025),
        "rosrv-hook": (61026, 61026),
    }


def test_a_user_of_that_name_is_preferred(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    made = pwd.struct_passwd(("rosrv", "x", 123, 456, "", "/", "/bin/false"))
    monkeypatch.setattr(pwd, "getpwnam", lambda _name: made)
    assert (account_of("rosrv").uid, account_of("rosrv").gid) == (123, 456)


def test_a_caller_who_is_not_root_runs_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(os, "getegid", lambda: 1001)
    assert {(account_of(user).uid, account_of(user).gid) for user in NUMERIC_IDS} == {(1000, 1001)}
