"""The gate of the policy: what the text of a policy must pass before it comes into force, at a load and at a start.

The supervisor imports this module too, so it does not import the store.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from appliance.base.input_files import read_given_text
from appliance.control.errors import PolicyRefusedError
from appliance.policy.judgement import PolicyContext, judge
from appliance.policy.policy import Policy
from appliance.policy.policy_findings import PolicyError
from appliance.signing.site_keys import read_signature

_KEPT = (
    "this is revision {0.revision}, which {0.who} brought into force while the appliance ran. To discard it, start with"
    " the version and configuration that took it, run `rosrv policy reload` there, and start again"
)
_NOT_EITHER = "revision {0.revision}, which was in force before, cannot come into force either: {1}"


class KeptPolicy(NamedTuple):
    """The last stored revision, which `who` brought into force."""

    revision: int
    text: str
    file: str
    who: str
    signature: str


class StartingPolicy(NamedTuple):
    """The policy that a start brings into force; `refused` is the error of the file, if the file is not used."""

    policy: Policy
    signature: str
    refused: PolicyRefusedError | None = None


def policy_at_start(
    kept: KeptPolicy | None, file: Path, known: PolicyContext, *, kept_first: bool
) -> StartingPolicy:
    """Return `kept` if it comes first or the file fails, else the file's policy. Raises `PolicyRefusedError`."""
    if kept is not None and kept_first:
        try:
            return StartingPolicy(accept(kept.text, kept.signature, kept.file, known), kept.signature)
        except PolicyRefusedError as error:
            raise PolicyRefusedError([*error.findings, _KEPT.format(kept)]) from error
    try:
        text, signature = read_policy(file)
        return StartingPolicy(accept(text, signature, str(file), with_cases(known, file)), signature)
    except PolicyRefusedError as refused:
        if kept is None:
            raise
        try:
            policy = accept(kept.text, kept.signature, kept.file, known)
        except PolicyRefusedError as error:
            raise PolicyRefusedError(
                [*refused.findings, _NOT_EITHER.format(kept, error.findings[0])]
            ) from error
        return StartingPolicy(policy, kept.signature, refused)


def read_policy(file: Path) -> tuple[str, str]:
    try:
        return read_given_text(file), read_signature(file)
    except (OSError, UnicodeDecodeError) as error:
        raise PolicyRefusedError([f"{file}: the policy cannot be read: {_error_text(error)}"]) from error


def accept(text: str, signature: str, file: str, known: PolicyContext) -> Policy:
    try:
        return judge(text, file, known, signature).accept()
    except PolicyError as error:
        raise PolicyRefusedError([str(finding) for finding in error.findings]) from error


def with_cases(known: PolicyContext, file: Path) -> PolicyContext:
    cases = file.with_name(f"{file.name}.tests.yaml")
    text = error = None
    try:
        text = read_given_text(cases)
    except FileNotFoundError:
        pass
    except (OSError, UnicodeDecodeError) as fault:
        error = f"the policy's tests cannot be read: {_error_text(fault)}"
    return replace(known, cases_file=str(cases), cases=text, cases_error=error)


def _error_text(error: OSError | UnicodeDecodeError) -> str:
    return (
        error.strerror or str(error)
        if isinstance(error, OSError)
        else f"it is not UTF-8 text: {error.reason}"
    )
