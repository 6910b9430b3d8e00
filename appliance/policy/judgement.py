"""Check the text, signature and test cases of a policy, for a load, a dry run or the command line."""

import ipaddress
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

from appliance.policy.cases import CaseResult, run_cases
from appliance.policy.host_sets import Network
from appliance.policy.model import Address, Category
from appliance.policy.policy import Approval, Policy
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import FindingSeverity, PolicyError, PolicyFinding
from appliance.signing.site_keys import UnsignedError, signer


def approvals_of(rows: Iterable[Iterable[str]]) -> frozenset[Approval]:
    return frozenset((ipaddress.ip_address(host), Category(category), name) for host, category, name in rows)


def ends_of(ended: Iterable[float], lasting: Iterable[float]) -> dict[float, bool]:
    return {**dict.fromkeys(lasting, False), **dict.fromkeys(ended, True)}


@dataclass(frozen=True, slots=True)
class PolicyContext:
    """The surroundings of a policy: the addresses of `host:NAME` and `robot`, and the test cases.

    `own` are the other addresses of the robot's machine, which belong to `robot` unless the policy names them.
    If the test cases could not be read, `cases_error` says why, and rejects the policy. `blocks`, `holders` and
    `approved` do not affect checks and test cases; None: they are not known.

    `now` is the time by which rights with a time are decided; None: the clock is not set. `ends` says of some ends of
    such rights whether they have passed, by the age clock. Both are in seconds since the epoch.
    """

    hosts: Mapping[str, Address] = field(default_factory=dict)
    robot: Collection[Address | Network] = ()
    cases_file: str = ""
    cases: str | None = None
    cases_error: str | None = None
    site_keys: Sequence[str] = ()
    blocks: Mapping[Address, str] = field(default_factory=dict)
    holders: Mapping[str, Address] | None = None
    approved: frozenset[Approval] | None = None
    own: Collection[Address] = ()
    now: float | None = None
    ends: Mapping[float, bool] = field(default_factory=dict)

    def compile(self, text: str, file: str) -> Policy:
        """Compile a text for these addresses. Raises `PolicyError`."""
        return compile_policy(
            text,
            file=file,
            hosts=self.hosts,
            robot=self.robot,
            own=self.own,
            now=self.now,
            ends=self.ends,
        )

    def complete(self, policy: Policy) -> Policy:
        """Return the policy with the present blocks, holders of groups and approvals, at the present time."""
        holders, policy = (
            None if self.holders is None else dict(self.holders),
            policy.at(self.now, self.ends),
        )
        return replace(policy, blocks=dict(self.blocks), holders=holders, approved=self.approved)

    def with_hosts(self, hosts: Mapping[str, Address]) -> Self:
        return replace(self, hosts={**self.hosts, **hosts})

    def with_holders(self, holders: Mapping[str, Address]) -> Self:
        return replace(self, holders={**(self.holders or {}), **holders})

    def with_approvals(self, approved: frozenset[Approval]) -> Self:
        return replace(self, approved=(self.approved or frozenset()) | approved)

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Self:
        return cls(
            {name: ipaddress.ip_address(address) for name, address in fields["hosts"].items()},
            [ipaddress.ip_network(place) for place in fields["robot"]],
            **{name: fields[name] for name in ("cases_file", "cases", "cases_error", "site_keys")},
            blocks={ipaddress.ip_address(address): block for address, block in fields["blocks"].items()},
            holders={group: ipaddress.ip_address(host) for group, host in (fields["holders"] or {}).items()},
            approved=approvals_of(fields["approved"]),
            own=[ipaddress.ip_address(address) for address in fields["own"] or ()],
            now=fields["now"],
            ends=ends_of(fields["ended"] or (), fields["lasting"] or ()),
        )

    def fields(self) -> dict[str, Any]:
        return {
            "hosts": {name: str(address) for name, address in self.hosts.items()},
            "robot": [str(place) for place in self.robot],
            "own": [str(address) for address in self.own],
            "cases_file": self.cases_file,
            "cases": self.cases,
            "cases_error": self.cases_error,
            "site_keys": list(self.site_keys),
            "blocks": {str(address): block for address, block in self.blocks.items()},
            "holders": {group: str(host) for group, host in (self.holders or {}).items()},
            "approved": [[str(host), category.value, name] for host, category, name in self.approved or ()],
            "now": self.now,
            "ended": [end for end, passed in self.ends.items() if passed],
            "lasting": [end for end, passed in self.ends.items() if not passed],
        }


IN_CONTROL = PolicyContext(holders={}, approved=frozenset())
"""Where all holders and approvals are known: there are none yet."""


class PolicyJudgement(NamedTuple):
    """A policy without errors in its text, and the results of its test cases."""

    policy: Policy
    results: list[CaseResult]
    signed_by: str

    def accept(self) -> Policy:
        """Return the policy. Raises `PolicyError` with every failed test case."""
        failed = [result.finding for result in self.results if not result.passed]
        if failed:
            raise PolicyError(failed)
        return self.policy


def judge(text: str, file: str, known: PolicyContext, signature: str = "") -> PolicyJudgement:
    """Check a text. Raises `PolicyError` with all its errors, or else those of the signature and the test cases."""
    policy = known.compile(text, file)
    try:
        signed_by = signer(known.site_keys, text, signature)
    except UnsignedError as error:
        raise PolicyError([PolicyFinding(file, 1, 1, FindingSeverity.ERROR, str(error))]) from None
    if known.cases_error is not None:
        raise PolicyError([PolicyFinding(known.cases_file, 1, 1, FindingSeverity.ERROR, known.cases_error)])
    results = [] if known.cases is None else run_cases(policy, known.cases, known.cases_file)
    return PolicyJudgement(policy, results, signed_by)
