"""The access policy: INI text in, `Policy` out; `Policy.decide(request)` is a pure function.

No I/O and no clock: that is what makes a decision testable, explainable and provable.
"""

from appliance.policy.compiler import compile_policy
from appliance.policy.findings import Finding, PolicyError, Severity
from appliance.policy.model import Address, Category, Decision, Request, Rule
from appliance.policy.policy import Policy, needs_node_rule

__all__ = [
    "Address",
    "Category",
    "Decision",
    "Finding",
    "Policy",
    "PolicyError",
    "Request",
    "Rule",
    "Severity",
    "compile_policy",
    "needs_node_rule",
]
