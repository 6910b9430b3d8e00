"""Each order that may stop or change a motion can wait until the robot stands, or has a reason not to wait."""

from pathlib import Path
from typing import Any

import pytest

from appliance.channel.admin import AdminAnswer, AdminRequest, answer_to, verb_of
from appliance.channel.operations import REQUESTS
from appliance.channel.rest_operation import rows
from appliance.cli.connection.admin_client import AdminSocket
from tests.support.answers import example
from tests.support.command import commands, rosrv
from tests.support.rows import require_rows
from tests.support.sources import ROOT

DEADMAN = (ROOT / "monitors/guards/deadman.rv").read_text(encoding="utf-8")
WAITS = {
    "policy load": ("policy enforce",),  # `policy grant --load` only adds a right
    "policy reload": ("policy reload",),
    "monitor load": ("monitor load",),
    "monitor replace": ("guard set",),
    "monitor reload": ("monitor reload",),
    "monitor switch": ("monitor enable",),
    "monitor shadow": ("monitor enforce", "guard enforce"),
    "monitor set": ("monitor set", "guard set"),
    "guard new": ("guard new",),
    "guard upgrade": ("guard upgrade",),
    "bundle take": ("fleet take",),
    "standby promote": ("standby switch",),
    "adopt": ("adopt",),
}
"""The orders, and the verbs that give them with `--when-standing`."""

_ENDS = "it ends a protection, and no motion; a false stop must be removable at once"
_NOW = "an operator who takes a right from a host wants it to end now"
_PERSON = "it is an operator's answer to one person or node that waits"
_NO_MOTION = "it changes no topic, service or right of a node"
_READS = "it only looks"
AT_ONCE = {
    "release": "it always waits, unless --force is given",
    "policy rollback": "it undoes a change that may be the harm",
    "monitor rollback": "it undoes a change that may be the harm",
    "policy confirm": _NO_MOTION,
    "monitor confirm": _NO_MOTION,
    "guard test": "it is rejected unless the robot stands still",
    "guard set": "a client of REST gives it: the verb `guard set` gives `monitor replace` and `monitor set`",
    "monitor remove": _ENDS,
    "monitor resume": _ENDS,
    "monitor try": _READS,
    "guard try": _READS,
    "topic look": _READS,
    "monitor values": _READS,
    "sso list": _READS,
    "token list": _READS,
    "host kit": _READS,
    "adopt status": _READS,
    "driver check": "it measures how a motion ends, so it needs one",
    "host block": _NOW,
    "host revoke": _NOW,
    "host unblock": _ENDS,
    "door remove": _NOW,
    "sso end": _NOW,
    "sso sign out": _NOW,
    "token revoke": _NOW,
    "approve": _PERSON,
    "approval refuse": _PERSON,
    "drive take": _PERSON,
    "drive give": _PERSON,
    "drive ask": _PERSON,
    "door visit": _PERSON,
    "door ticket": _PERSON,
    "host renew": _NO_MOTION,
    "hosts reload": _NOW,
    **dict.fromkeys(
        (
            "token add", "token rotate", "alarm acknowledge", "alarm silence", "host token", "host add",
            "host ports", "door add", "record now", "recording memory", "recording remove",
        ),
        _NO_MOTION,
    ),
}  # fmt: skip
_UNTRIED = {
    "adopt": "it needs root; `tests/system/network/test_adopt.py`",
    "policy enforce": "it needs an audit log; `tests/system/network/test_adopt.py`",
}
_CALLS = {
    "policy reload": (),
    "monitor load": ("zone.rv",),
    "monitor reload": (),
    "monitor enable": ("deadman",),
    "monitor enforce": ("deadman",),
    "monitor set": ("deadman", "silent=1"),
    "guard new": ("deadman", "/cmd_vel"),
    "guard set": ("deadman", "silent=1"),
    "guard enforce": ("deadman",),
    "guard upgrade": ("deadman",),
    "fleet take": (),
    "standby switch": (),
}
_ANSWERS: dict[str, dict[str, Any]] = {
    "monitors": {
        "monitors": [{"name": "deadman", "file": "deadman.rv"}],
        "files": {"deadman.rv": DEADMAN},
    },
    "status": {"bundles": {"for_order": "site-a/arms/2.tar"}},
}


def is_order(request: type[AdminRequest[Any]]) -> bool:
    operations = rows().get(request, ())
    return not operations or any(
        one.method not in ("", "GET") or one.role in ("operator", "admin") for one in operations
    )


def test_each_order_waits_or_has_a_reason() -> None:
    orders = {str(request.__struct_config__.tag) for request in REQUESTS if is_order(request)}
    assert not WAITS.keys() & AT_ONCE.keys()
    require_rows(orders, WAITS.keys() | AT_ONCE.keys(), "WAITS, or AT_ONCE with the reason")
    waiting = {
        name for name, verb in commands() if any("--when-standing" in param.opts for param in verb.params)
    }
    require_rows({verb for verbs in WAITS.values() for verb in verbs}, waiting, "WAITS")
    require_rows(waiting, _CALLS.keys() | _UNTRIED.keys(), "_CALLS, or _UNTRIED with the reason")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    said: list[str] = []

    def ask(_socket: AdminSocket, request: AdminRequest[Any]) -> AdminAnswer[Any]:
        said.append(verb_of(request))
        return AdminAnswer(True, example(answer_to(type(request)), **_ANSWERS.get(said[-1], {})))

    monkeypatch.setattr(AdminSocket, "ask", ask)
    return said


@pytest.mark.parametrize("verb", _CALLS)
def test_no_order_is_given_while_the_robot_is_not_known_to_stand(
    verb: str, asked: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("zone.rv").write_text(DEADMAN)
    given = {order for order, verbs in WAITS.items() if verb in verbs}
    call = (*verb.split(), *_CALLS[verb], "--state", str(tmp_path))
    rosrv(*call)
    assert given & {*asked}, f"without the option, {verb} gives its order"
    asked.clear()
    done = rosrv(*call, "--when-standing")
    assert (done.returncode, not given & {*asked}) == (1, True), done.stderr
    assert "Nothing was changed" in done.stderr
