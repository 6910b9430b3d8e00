from collections.abc import Iterator

import msgspec
import pytest

from appliance.cli.connection.admin_client import NotRunningError
from appliance.features.approvals import verbs
from appliance.features.approvals.requests import Approval, Approvals, ApprovalsWanted, RefuseCall
from appliance.features.approvals.verbs import changes
from tests.support.memory_call import call_of
from tests.support.rest_world import ROLES, RestWorld

REST = ("10.0.0.7", "/agent", "call", "/log", "roscpp/SetLoggerLevel", "4bf5")


@pytest.mark.parametrize(
    ("size", "shown"),
    [(4096, "'level': '…'}: waits"), (5000, "'level': '…'}, and 904 more bytes, which are not")],
)
def test_an_operator_sees_that_arguments_are_cut(
    capsys: pytest.CaptureFixture[str], size: int, shown: str
) -> None:
    data = (5000).to_bytes(4, "little") + b"x" * 4092
    row = Approval(48213, "waits", *REST, data.hex(), size, 60.0, "")  # type: ignore[arg-type]  # of a tuple
    verbs.approve.function(call_of(lambda _request: Approvals([row])), None)
    assert shown in capsys.readouterr().out


@pytest.mark.parametrize(
    ("service", "data", "shown"),
    [
        ("std_srvs/SetBool", b"\x01", " {'data': True}: waits"),
        (
            "std_srvs/SetBool",
            b"\x01\x00evil",
            " {'data': True}, and 5 bytes behind the last field: 006576696c: waits",
        ),
        ("std_srvs/Empty", b"go", " {}, and 2 bytes behind the last field: 676f: waits"),
        ("std_srvs/Empty", b"", " {}: waits"),
        ("own/Unknown", b"\x01x", " b'\\x01x' (own/Unknown, sha256 4bf5): waits"),
        ("own/Unknown", b"", " {}: waits"),
        ("roscpp/SetLoggerLevel", b"\x09\0\0\0ab", "'logger': '…', 'level': '…'}: waits"),
    ],
)
def test_an_operator_sees_every_byte_of_the_arguments(
    capsys: pytest.CaptureFixture[str], service: str, data: bytes, shown: str
) -> None:
    call = ("10.0.0.7", "/agent", "call", "/set", service, "4bf5")
    row = Approval(48213, "waits", *call, data.hex(), len(data), 60.0, "")  # type: ignore[arg-type]  # of a tuple
    verbs.approve.function(call_of(lambda _request: Approvals([row])), None)
    assert shown in capsys.readouterr().out


@pytest.mark.parametrize("role", ROLES)
def test_a_viewer_reads_no_arguments_of_held_calls(role: str, capsys: pytest.CaptureFixture[str]) -> None:
    world = RestWorld()
    held = Approval(7, "waits", *REST, b"secret".hex(), 6, 60.0, "")  # type: ignore[arg-type]  # of a tuple
    world.carried.answers[ApprovalsWanted] = Approvals([held])
    told = msgspec.json.decode(world.asked("GET", "/v1/approvals", None, role).content, type=Approvals)
    assert (told.approvals == [held]) is (role != "viewer")
    verbs.approve.function(call_of(lambda _request: told), None)
    words = "with 6 bytes of arguments, which viewers do not see: waits"
    assert (words in capsys.readouterr().out) is (role == "viewer")
    assert role != "viewer" or (told.approvals[0].arguments, told.approvals[0].sha256) == ("", "withheld")


def test_a_watched_call_is_shown_when_it_comes_changes_and_ends() -> None:
    call = Approval(7, "waits", *REST, "", 0, 60.0, "")  # type: ignore[arg-type]  # of a tuple
    timed = msgspec.structs.replace(call, state="lease", who="ann")
    assert list(changes({}, [call])) == [call]
    assert list(changes({7: call}, [msgspec.structs.replace(call, left_seconds=50.0)])) == []
    assert list(changes({7: call}, [timed])) == [timed]
    assert list(changes({7: timed}, [])) == [msgspec.structs.replace(timed, left_seconds=0.0)]


def test_the_watch_goes_on_while_the_appliance_restarts(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    call = Approval(7, "waits", *REST, "", 0, 60.0, "")  # type: ignore[arg-type]  # of a tuple
    answers: Iterator[Approvals | NotRunningError] = iter(
        [Approvals([call]), NotRunningError("away"), NotRunningError("away"), Approvals([])]
    )

    def answer(_request: object) -> Approvals:
        match next(answers, None):
            case None:
                raise KeyboardInterrupt
            case NotRunningError() as error:
                raise error
            case approvals:
                return approvals

    monkeypatch.setattr(verbs, "_EVERY_SECONDS", 0)
    call_of_verb = call_of(answer, names=lambda host: f"agent ({host})")
    verbs.approve.function(call_of_verb, None, watch=True)
    out, err = capsys.readouterr()
    assert "7: agent (10.0.0.7) call /log" in out
    assert "rosrv approve 7 --for 30s" in out
    assert out.splitlines()[-1] == "7: has ended"
    assert err.count("trying again") == 1


def test_a_call_is_refused() -> None:
    refused = Approval(7, "refused", *REST, "", 0, 60.0, "ann")  # type: ignore[arg-type]  # of a tuple
    asked: list[object] = []

    def answer(request: object) -> Approval:
        asked.append(request)
        return refused

    verbs.refuse.function(call_of(answer), 7)
    assert asked == [RefuseCall(7)]
