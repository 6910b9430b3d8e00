"""Define the stable names of all events, for the documentation and for search filters.

A name is never renamed and never reused for another event. A new name is added here, with its description, before it
is recorded.
"""

from appliance.audit.record import Severity

EVENTS: dict[str, str] = {
    "decision": "A request was decided by the policy (allow, deny, would deny).",
    "registered": "A node registered a publication, subscription, service or parameter subscription.",
    "unregistered": "A node withdrew a registration.",
    "revoked": "A registration, grant or connection was taken back because the policy no longer allows it.",
    "node lost": "A node no longer answers; its registrations are kept back until it returns or is removed.",
    "node returned": "A lost node answers again.",
    "replaced": "A node registered again under its name from the same host: the one before was told to shut down.",
    "takeover": "A node registered under a name that another host holds.",
    "policy loaded": "A policy came into force; `detail` has who, from where, and the hash of its text.",
    "policy confirmed": "A policy that was loaded with commit-confirm was confirmed and stays in force.",
    "policy refused": "A new policy has errors and was refused whole; the last good one stays in force.",
    "host enrolled": "A host got a certificate and its virtual address; `detail` has both and who asked.",
    "host renewed": "A host got a new certificate, and the one before was revoked.",
    "host revoked": "A host may no longer come: certificate revoked, tunnel closed, registrations taken back.",
    "certificate ends soon": "The certificate of an enrolled host ends within days and was not renewed.",
    "certificate ended": "The certificate of an enrolled host has ended: it cannot come any more.",
    "host awaited": "A one-time token was made: whoever brings it is enrolled as this host.",
    "host awaited no longer": "A one-time token for enrolment was revoked before it was used.",
    "hosts reloaded": "The file of declared hosts was read again; `detail` has what that opened and closed.",
    "enrolment refused": "An enrolment was refused; `host` is the real address.",
    "renewal refused": "A host asked for a new certificate and was refused.",
    "ports checked": "The result of a check of a machine's ROS ports from outside was reported; `detail` has who.",
    "topics moved": "Topics or services are carried by another relay process; `detail` has which, and their monitors.",
    "tunnel up": "The tunnel of an enrolled host is up; `host` is its virtual address, `detail` has the real one.",
    "tunnel moved": "A standing tunnel comes from another real address now; `detail` has both.",
    "tunnel down": "The tunnel of an enrolled host is down; nothing of it is accepted until it is back.",
    "tunnel refused": "A tunnel was refused; `host` is the real address, `reason` says why.",
    "packets refused": "Packets of tunnels were dropped: sent again, or under another's address (user-space ESP only).",
    "specifications confirmed": "Specifications that were loaded with commit-confirm were confirmed and stay in force.",
    "specifications loaded": "Specifications of monitors came into force; `detail` has who, which files changed, and"
    " the hashes of all of them and of what they were compiled to, which is what relays run.",
    "specifications refused": "Specifications have errors and were refused whole; those before stay in force.",
    "monitor enabled": "A monitor was switched on; `detail` has who.",
    "monitor disabled": "A monitor was switched off: messages pass it untouched; `detail` has who, and `until` if"
    " it comes back by itself.",
    "monitor in shadow mode": "A monitor gets copies of messages and has no effect; `detail` has who.",
    "shadow observed": "A monitor in shadow mode would have done something: `detail.would` is drop, change, verdict,"
    " fault, log or publish, or `missed` for a message that it did not get.",
    "monitor resumed": "The topics that a monitor held after a restart go on; `detail` has who.",
    "monitors restarted": "A new relay process: monitors began in their initial state, some hold their topics.",
    "topics held": "A monitor's state was lost, so it holds its topics until an operator resumes it.",
    "monitor verdict": "A property of a monitor is in a category that is handled; `detail` has logic and category, of a"
    " parametric specification the `binding`, `at` its place, `why` which events alone give the verdict,"
    " and `conditions` what they compared.",
    "message dropped": "A monitor dropped a message; the first of a second in full, the rest as `detail.count`. `at` is"
    " where the statement stands that did, `conditions` has what led there: each with the values that it compared;"
    " `handler` the verdict in whose handler it was, with its `why`.",
    "message changed": "Monitors changed a message; `detail` has the bytes before and after, `changed_by` the events"
    " that did, in order, `monitor` whose the last is. A `count` has `changed_by` if it was more than one monitor.",
    "monitor fault": "An action of a monitor could not go on; `detail` has file, line, values and `conditions`.",
    "monitor log": "A monitor wrote a line.",
    "monitor published": "A monitor published a message; `at` is where the statement stands, `conditions` has what led"
    " there; `handler` the verdict in whose handler it was, with its `why`.",
    "publication refused": "A publisher or service has another definition than the specifications; it is not carried.",
    "recording ordered": "A recording was ordered; `detail` has who, and the seconds before and after.",
    "recording closed": "The flight recorder has a recording; `detail` has its sha256, and what triggered it.",
    "recording fetched": "The messages of a recording were fetched; `detail` has who.",
    "recording read": "Messages of a recording were read, decoded; `detail` has who, and the topics.",
    "recording removed": "A recording was removed: `detail.who` has by whom; `recorder` to make room, or by age.",
    "recording missed": "A trigger made no recording: `reason` says why (the hour's number, the disk);"
    " `detail.recording` is the one that its record had promised.",
    "topic looked into": "Messages of a topic were shown; `detail` has who, and the `seconds` that the record covers.",
    "rest call": "A REST call was answered; `detail` has who (the token's name), method and status.",
    "evidence exported": "A bundle of evidence was made; `detail` has who, the hash of its manifest and its span.",
    "order refused": "RVMaster refused what was asked over REST: no token, role or proof; `detail.verb` says what.",
    "token added": "An access token for REST was made; `detail` has its name, role, id and end.",
    "token revoked": "An access token for REST was ended before its time.",
    "process started": "A process of the appliance started.",
    "process died": "A process of the appliance ended without being told to.",
    "process failing": "A process of the appliance ends soon after every start; `reason` says why, `detail.output` has"
    " the last lines that it printed. It is started again, ever later, up to once in a minute.",
    "appliance started": "The appliance is in service.",
    "appliance stopped": "The appliance ended in an orderly way.",
    "malformed": "A peer sent what is no request, or a publisher what is no header; it was refused: see `reason`.",
    "connection opened": "A subscriber or service client is connected through the relay.",
    "connection closed": "A connection through the relay ended.",
    "connection refused": "A connection had no grant or a wrong header, or a publisher refused the appliance.",
    "limit exceeded": "A peer sent more, larger or faster than the limits allow.",
    "rate limited": "Messages beyond a limit of the policy ([Limits]) were dropped; `rule` has the limit,"
    " `detail.count` how many they were.",
    "probe failed": "The hidden ROS Master could be reached from outside; nodes are not served meanwhile.",
    "probe passed": "The ROS Master is hidden (again).",
    "reconciled": "The reconcile loop found and mended a difference between wanted and seen.",
    "denials folded": "Repetitions of a denial recorded before; `detail` has how many, first and last.",
    "repetitions folded": "Repetitions of a read that was allowed, recorded before, and whatever else a host beyond its"
    " share repeats; `detail` has how many, first and last.",
    "log begun": "The first record of a new log; `detail.earlier_log_missing`: there was one before.",
    "records removed": "Retention removed old records; `detail` has which, why, and their last hash.",
    "records lost": "The queue was full while the log could not be written; `detail` has how many.",
    "checkpoint": "The state of the chain up to the record before was sealed for signing.",
    "signature refused": "The signer refused a checkpoint, or its signature is wrong or of another key.",
    "forwarding failed": "The receiver of the forwarded log could not be reached for ten seconds; records wait here.",
    "forwarding resumed": "The receiver of the forwarded log has it again.",
    "forwarding gap": "Retention removed records before they could be forwarded; `detail` has how many.",
    "disk nearly full": "Only the reserve of the log's disk is left (`audit.reserve_bytes`): `reason` says what to do.",
    "disk has room": "There is more than the reserve on the log's disk again.",
    "clock not synchronised": "No time service keeps the machine's clock: the times of records may be wrong.",
    "clock synchronised": "A time service keeps the machine's clock again.",
    "clock set forward": "The machine's clock went further than time has passed; `detail` has by how many seconds.",
    "clock set back": "The machine's clock stands before the last record; `detail` has by how many seconds.",
    "protection forgotten": "A monitor is disabled or in shadow mode, or a section of the policy audit-only, for longer"
    " than `forgotten_after`; `resource` names it, `reason` says what brings it back.",
    "log failed": "The log could not be written for a time, and can be again; `reason` says why.",
}

SEVERITIES: dict[str, Severity] = {
    name: severity
    for severity, names in {
        Severity.NOTICE: (
            "appliance started", "appliance stopped", "clock not synchronised", "clock synchronised",
            "evidence exported", "forwarding resumed", "host awaited", "host awaited no longer", "host enrolled",
            "host renewed", "hosts reloaded", "monitor resumed", "policy loaded", "recording closed",
            "recording ordered", "recording fetched", "recording read", "recording removed", "specifications loaded",
            "token added", "token revoked", "topic looked into", "tunnel down", "tunnel moved", "tunnel up",
            "probe passed",
        ),
        Severity.WARNING: (
            "certificate ended", "certificate ends soon", "clock set back", "clock set forward", "enrolment refused",
            "forwarding failed", "host revoked", "limit exceeded", "malformed", "packets refused", "policy refused",
            "recording missed", "renewal refused", "specifications refused", "tunnel refused",
        ),
        Severity.ALARM: (
            "forwarding gap", "monitors restarted", "probe failed", "process failing", "protection forgotten",
            "publication refused", "records lost", "topics held",
        ),
    }.items()
    for name in names
}  # fmt: skip
"""The severity of each event for which it is fixed. For other events, the recording code gives it; default: INFO."""
