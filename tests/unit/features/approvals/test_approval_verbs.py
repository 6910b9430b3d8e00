from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.cli.connection.target import Appliance
from appliance.features.approvals import approval_verbs
from appliance.features.approvals.approval_requests import Approval, Approvals

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
    fake = SimpleNamespace(as_json=False, answer_or_exit=lambda _request: Approvals([row]))
    cast(Any, approval_verbs.approve).function(cast(Appliance, fake), None)
    assert shown in capsys.readouterr().out
