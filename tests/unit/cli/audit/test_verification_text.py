import pytest

from appliance.audit.proof.chain_findings import Verification
from appliance.cli.audit.verification_text import print_verification


@pytest.mark.parametrize(
    ("signed_through", "verdict"),
    [
        (0, "The log is consistent, but nothing is signed yet"),
        (7, "The log is complete and unchanged."),
    ],
)
def test_a_log_is_complete_only_once_something_is_signed(
    capsys: pytest.CaptureFixture[str], signed_through: int, verdict: str
) -> None:
    print_verification(
        Verification(
            ok=True, log="one", first=1, last=9, records=9, removed=0, checkpoints=1, signed_checkpoints=1,
            signed_through=signed_through, unsealed=2, key="", findings=[],
        )
    )  # fmt: skip
    assert capsys.readouterr().out.splitlines()[-1].startswith(verdict)
