"""Whether a policy can be taken: text and test cases, judged alike for a load, a dry run and the command line."""

import ipaddress
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

from appliance.policy.cases import CaseResult, run_cases
from appliance.policy.host_sets import Network
from appliance.policy.model import Address
from appliance.policy.policy import Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import Finding, PolicyError, Severity
from appliance.signing.site_keys import UnsignedError, signer


@dataclass(frozen=True, slots=True)
class Known:
    """What a policy is judged with: whom `host:NAME` and `robot` mean, and the text of its test cases.

    `cases` is None where it has no cases; `cases_error` is why they could not be read, which refuses the policy.
    Where there are `site_keys`, one of them must have signed it.
    """

    hosts: Mapping[str, Address] = field(default_factory=dict)
    robot: Collection[Address | Network] = ()
    cases_file: str = ""
    cases: str | None = None
    cases_error: str | None = None
    site_keys: Sequence[str] = ()

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Self:
        """From `fields`, among which others may be."""
        return cls(
            {name: ipaddress.ip_address(address) for name, address in fields["hosts"].items()},
            [ipaddress.ip_network(place) for place in fields["robot"]],
            *(fields[name] for name in ("cases_file", "cases", "cases_error", "site_keys")),
        )

    def fields(self) -> dict[str, Any]:
        """For another process."""
        return {
            "hosts": {name: str(address) for name, address in self.hosts.items()},
            "robot": [str(place) for place in self.robot],
            "cases_file": self.cases_file,
            "cases": self.cases,
            "cases_error": self.cases_error,
            "site_keys": list(self.site_keys),
        }


class Judged(NamedTuple):
    """A policy that can be compiled, what its test cases say of it, and which key of the site signed it."""

    policy: Policy
    results: list[CaseResult]
    signed_by: str

    def accepted(self) -> Policy:
        """The policy; raises `PolicyError` with each case that it fails."""
        failed = [result.finding for result in self.results if not result.passed]
        if failed:
            raise PolicyError(failed)
        return self.policy


def judge(text: str, file: str, known: Known, signature: str = "") -> Judged:
    """Compile a policy (`file` names it in findings and rules), look at its signature and run its cases.

    Raises `PolicyError` with all that is wrong with the text, or else with the signature or the cases.
    """
    policy = compile_policy(text, file=file, hosts=known.hosts, robot=known.robot)
    try:
        signed_by = signer(known.site_keys, text, signature)
    except UnsignedError as error:
        raise PolicyError([Finding(file, 1, 1, Severity.ERROR, str(error))]) from None
    if known.cases_error is not None:
        raise PolicyError([Finding(known.cases_file, 1, 1, Severity.ERROR, known.cases_error)])
    results = [] if known.cases is None else run_cases(policy, known.cases, known.cases_file)
    return Judged(policy, results, signed_by)
