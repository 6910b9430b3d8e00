import pytest

from appliance.audit.proof.chain_findings import Elsewhere, Verification
from appliance.cli.audit.verification_text import print_verification

_COPIES = Elsewhere(checkpoints=1, through=7, time=0, other_logs=[])


@pytest.mark.parametrize(
    ("signed_through", "remembered", "elsewhere", "verdict"),
    [
        (0, 3, None, "The log is consistent, but nothing is signed yet"),
        (7, 3, None, "The log is complete and unchanged."),
        (7, None, _COPIES, "The log is complete and unchanged."),
        (
            9,
            None,
            _COPIES,
            "The log is unchanged, and complete up to record 7; later ones may have been cut off.",
        ),
        (9, 3, _COPIES, "The log is complete and unchanged."),
        (
            7,
            None,
            None,
            "The log is consistent and its signatures are valid, but records may have been cut off",
        ),
        (7, 0, None, "The log is consistent and its signatures are valid, but records may have been cut off"),
    ],
)
def test_a_log_is_complete_only_by_a_signature_and_a_memory_outside_it(
    capsys: pytest.CaptureFixture[str],
    signed_through: int,
    remembered: int | None,
    elsewhere: Elsewhere | None,
    verdict: str,
) -> None:
    print_verification(
        Verification(
            ok=True, log="one", first=1, last=9, records=9, removed=0, checkpoints=1, signed_checkpoints=1,
            signed_through=signed_through, unsealed=2, key="", findings=[], elsewhere=elsewhere,
            remembered=remembered,
        )
    )  # fmt: skip
    assert capsys.readouterr().out.splitlines()[-1].startswith(verdict)
