"""The access policy: INI text in, `Policy` out; `Policy.decide(request)` is a pure function.

No I/O and no clock: that is what makes a decision testable, explainable and provable.
"""

from appliance.policy.cases import CaseResult, run_cases
from appliance.policy.compiler import compile_policy
from appliance.policy.diff import Difference, diff
from appliance.policy.explain import Explanation, explain
from appliance.policy.findings import Finding, PolicyError, Severity
from appliance.policy.judgement import Judged, Known, judge
from appliance.policy.live import Ending, Live, endings
from appliance.policy.model import Address, Category, Decision, Request, Rule
from appliance.policy.policy import Policy

__all__ = [
    "Address",
    "CaseResult",
    "Category",
    "Decision",
    "Difference",
    "Ending",
    "Explanation",
    "Finding",
    "Judged",
    "Known",
    "Live",
    "Policy",
    "PolicyError",
    "Request",
    "Rule",
    "Severity",
    "compile_policy",
    "diff",
    "endings",
    "explain",
    "judge",
    "run_cases",
]
