"""The stable names of what is recorded: the registry that documentation and search filters are made from.

A name is never reused for something else and never renamed; a new one is added here with its line of
description before it is recorded.
"""

EVENTS: dict[str, str] = {
    "decision": "A request was decided by the policy (allow, deny, would deny).",
    "registered": "A node registered a publication, subscription, service or parameter subscription.",
    "unregistered": "A node withdrew a registration.",
    "revoked": "A registration, grant or connection was taken back because the policy no longer allows it.",
    "node lost": "A node no longer answers; its registrations are kept back until it returns or is removed.",
    "node returned": "A lost node answers again.",
    "takeover": "A node registered under a name that another host holds.",
    "policy loaded": "A policy came into force; `detail` has who, from where and what changed.",
    "policy confirmed": "A policy that was loaded on trial was confirmed and stays in force.",
    "policy refused": "A new policy has errors and was refused whole; the last good one stays in force.",
    "rest call": "A REST call was answered; `detail` has who (the token's name), method and status.",
    "token added": "An access token for REST was made; `detail` has its name, role, id and end.",
    "token revoked": "An access token for REST was ended before its time.",
    "process started": "A process of the appliance started.",
    "process died": "A process of the appliance ended without being told to.",
    "appliance started": "The appliance is in service.",
    "appliance stopped": "The appliance ended in an orderly way.",
    "malformed": "A peer sent what is no request; it was refused, and `reason` says why.",
    "connection opened": "A subscriber or service client is connected through the relay.",
    "connection closed": "A connection through the relay ended.",
    "connection refused": "Somebody connected without a grant, or with a header that is not allowed.",
    "limit exceeded": "A peer sent more, larger or faster than the limits allow.",
    "probe failed": "The hidden ROS Master could be reached from outside; nodes are not served meanwhile.",
    "probe passed": "The ROS Master is hidden (again).",
    "reconciled": "The reconcile loop found and mended a difference between wanted and seen.",
    "denials folded": "Repetitions of a denial recorded before; `detail` has how many, first and last.",
    "log begun": "The first record of a new log; `detail.earlier_log_missing`: there was one before.",
    "records removed": "Retention removed old records; `detail` has which, why, and their last hash.",
    "records lost": "The queue was full while the log could not be written; `detail` has how many.",
    "checkpoint": "The state of the chain up to the record before was sealed for signing.",
    "signature refused": "The signer refused a checkpoint, or its signature is wrong or of another key.",
    "log failed": "The log could not be written for a time, and can be again; `reason` says why.",
}
