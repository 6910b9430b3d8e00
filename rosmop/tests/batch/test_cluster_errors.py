import pytest

from rosmop.batch.ray_cluster import _reason


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ("one\ntwo", "one"),
        ("announced:\ntwo\nthree", "announced: two"),
        (
            "failure from server:\nTraceback (most recent call last):\n  File x\nRuntimeError: see y.err\n",
            "failure from server: RuntimeError: see y.err",
        ),
    ],
)
def test_the_line_has_the_cause(message: str, reason: str) -> None:
    assert _reason(ConnectionAbortedError(message)) == f"ConnectionAbortedError: {reason}"
