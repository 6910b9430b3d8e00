"""The quotas of single sign-on."""

from appliance.quotas.pool import Bounds
from appliance.quotas.table import HonestUse, QuotaRow

SIGN_ONS = QuotaRow(
    thing="sign-ons at the provider that are not finished",
    bounds=Bounds(whole=256, host=256, unknown=256, kept=0),
    at_limit="if all are taken, the oldest one of the address with most ends; an address begins at most"
    " `api_limits.failures_per_minute` a minute that it does not complete",
    between="the address with most loses one; of those that run at once (6), the next is of the address with fewest,"
    " then of the one that has used least",
    counting="an IPv6 network (/64) is one address",
    alarm="none: the person signs in again",
    margin=HonestUse(
        "ten people behind one address who sign on at once",
        10,
        beyond="the first of them signs on again",
    ),
)
SESSIONS = QuotaRow(
    thing="sessions of people who signed in at the provider",
    bounds=Bounds(whole=500, host=8, unknown=0, kept=0),
    at_limit="the oldest session of the person ends; beyond the whole, a sign-on is refused",
    counting="a person is a `sub` of the provider",
    alarm="`sign-on refused`",
    margin=HonestUse(
        "one person with a browser on four machines",
        4,
    ),
)

ROWS = (SIGN_ONS, SESSIONS)
