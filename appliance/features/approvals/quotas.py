"""The quotas of approvals."""

from appliance.quotas.pool import Bounds
from appliance.quotas.table import HonestUse, QuotaRow

APPROVALS = QuotaRow(
    thing="calls that wait for an approval, and approvals",
    bounds=Bounds(whole=256, host=8, unknown=64, kept=0),
    at_limit="the call is denied without a number: operators decide about the host's other calls first",
    between="a host has at most 8 of them, whatever it calls",
    counting="hosts that the policy names as one network count as one; unknown: only `*` names the host; repetitions of"
    " a call are one; each ends after two minutes, or with its approval",
    alarm="`approval-unanswered`, `rosrv limits`",
    margin=HonestUse(
        "one person or agent with three calls that wait",
        3,
    ),
)

ROWS = (APPROVALS,)
