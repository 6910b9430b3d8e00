"""Define the stable names of all events. A name is never renamed and never reused for another event."""

from appliance.audit.log.record import Severity

EVENTS: dict[str, str] = {
    "decision": "A request was decided by the policy (allow, deny, would deny, ask).",
    "registered": "A node registered a publication, subscription, service or parameter subscription.",
    "unregistered": "A node withdrew a registration.",
    "revoked": "A registration, grant or connection was revoked because the policy no longer allows it.",
    "node lost": "A node no longer answers; its registrations are suspended until it returns or is removed.",
    "node returned": "A lost node answers, or is connected, again.",
    "replaced": "A node registered again under its name from the same host; the earlier node got a shutdown call.",
    "takeover": "A node registered under a name that another host holds.",
    "policy loaded": "A policy came into force; `diff` has its changed lines (at most 32,768 characters).",
    "policy confirmed": "A policy that was loaded with commit-confirm was confirmed and stays in force.",
    "policy refused": "A new policy has errors and was rejected as a whole; the previous policy stays in force.",
    "policy file refused": "The appliance started, and the policy's file has errors or fails its tests; the revision"
    " that was in force before stays in force.",
    "host enrolled": "A host got a certificate and its virtual address.",
    "host renewed": "A host got a new certificate; its previous certificate was revoked.",
    "host authority replaced": "The authority of hosts has another key (`rosrv host authority rotate`, or its files"
    " were removed): certificates of the earlier one are not accepted.",
    "host revoked": "A host was excluded: its certificate is revoked, its tunnel closed, its registrations removed.",
    "certificate ends soon": "The certificate of an enrolled host expires within days and was not renewed.",
    "certificate ended": "The certificate of an enrolled host has expired; the host can no longer connect.",
    "host blocked": "An operator blocked a host: all its requests are denied.",
    "host unblocked": "An operator lifted the block of a host.",
    "host block ended": "The time of a host's block was over; the host is decided by the policy again.",
    "rights changed": "Rights with a time (`until`, `during`) ended or began; `revoked` and `restored` are the numbers"
    " of registrations and connections.",
    "authority handed over": "A group of [Authority] has another holder, or none; `resource` is the group.",
    "approval ended": "A held call was not answered in time, or an approval is over; `reason` says why.",
    "approval given": "An operator approved a held call (rosrv approve), once or for some time.",
    "approval refused": "An operator refused a held call.",
    "approval used": "A host made the one call that an operator approved.",
    "approval wanted": "A host after `ask` in the policy made a call that needs an approval; `detail.approval` is its"
    " number.",
    "motion not stopped": "A host lost the right to command a motion, and no guard has a safe message that stops it, or"
    " its relay does not answer.",
    "motion stopped": "A host lost the right to command a motion, and guards send their safe messages.",
    "authority asked": "A host waits for a group of [Authority]; `resource` is the group.",
    "authority refused": "A host may not take a group of [Authority], or not now; `resource` is the group.",
    "alarm acknowledged": "An operator takes care of an alarm; `resource` is its kind.",
    "alarm silenced": "An operator made an alarm a notice for a time.",
    "alarm sounds again": "An operator ended the silence or the acknowledgement of an alarm.",
    "host awaited": "A one-time token was made; the host that presents it is enrolled under this name.",
    "host awaited no longer": "A one-time token was revoked before it was used, or while its host was being enrolled.",
    "hosts reloaded": "The file of declared hosts was read again; `diff` has its changed lines, `opened` and `closed`"
    " are tunnels.",
    "enrolment refused": "An enrolment was rejected; `host` is the real address.",
    "renewal refused": "A host's request for a new certificate was rejected.",
    "ports checked": "A check of a machine's ROS ports from outside was reported.",
    "topics moved": "Topics or services moved to another relay process.",
    "tunnel up": "The tunnel of an enrolled host is up; `host` is its virtual address, `remote` the real one.",
    "tunnel moved": "An open tunnel now comes from another real address.",
    "tunnel down": "The tunnel of an enrolled host is down; no packets of the host are accepted until it is up again.",
    "tunnel refused": "A tunnel was refused; `host` is the real address, `reason` says why.",
    "packets refused": "Packets of tunnels were dropped: replayed, or with the address of another host (user-space ESP"
    " only).",
    "specifications confirmed": "Specifications that were loaded with commit-confirm were confirmed and stay in force.",
    "specifications loaded": "Specifications of monitors came into force; `diff` has the changed lines (at most 32,768"
    " characters), `compiled_sha256` the hashes of the modules that relays run, and `off` all monitors that are not in"
    " force, with their states.",
    "specifications refused": "Specifications have errors and were rejected as a whole; the previous ones stay in"
    " force.",
    "monitor not built": "The file of a monitor has an error at the start, for example after an upgrade. The appliance"
    " starts without the monitor, which holds its topics unless it is declared `begin`. If the topics of the file are"
    " not known (`resource` is the file), nothing holds them.",
    "monitor enabled": "A monitor was enabled.",
    "monitor disabled": "A monitor was disabled: its topics' messages pass unchanged. With `until`, it is enabled again"
    " at that time.",
    "monitor in shadow mode": "A monitor gets copies of messages and has no effect.",
    "shadow observed": "A monitor in shadow mode would have acted: `detail.would` is drop, change, verdict, fault, log"
    " or publish, or `missed` for a message that it did not get.",
    "monitor set": "An operator set a constant that is given to a monitor, or its default applies again, because the"
    " text no longer declares it with this range.",
    "driver checked": "An operator measured whether a robot's driver stops its base when commands end; `seconds` count"
    " from the last command.",
    "guard loaded": "A guard has another text or other values than before, after any kind of change; at each start of"
    " control, every guard. `origin` is `current`, `older` or `changed`, `below` has the values below the standard, and"
    " `digest` binds preset and values, as in `rosrv guard list --json`.",
    "guard tested": "A copy of a guard got a fault (`rosrv guard test`). `reached` has whom its stop reached, with"
    " seconds.",
    "guard late": "A guard acted more than `relay.late` later than it was due. It is recorded again when the guard was"
    " in time for a minute.",
    "heartbeat begun": "The heartbeat is on: every guard can act.",
    "heartbeat ended": "The heartbeat is off, for the reason in the record.",
    "guard bypassed": "A node took a guarded command from a publisher that the appliance did not give it, twice in a"
    " row. It is recorded again when this has ended and begins again.",
    "monitor resumed": "The topics that a monitor held after a restart resume.",
    "monitors restarted": "A relay process was restarted: its monitors are in their initial state, and some hold their"
    " topics.",
    "topics held": "A monitor's state was lost, so it holds its topics until an operator resumes it.",
    "monitor verdict": "A property of a monitor reached a category that has a handler; `detail` has the logic and the"
    " category, the `binding` for parametric specifications, and in `why` the events that alone give the verdict.",
    "message dropped": "A monitor dropped a message; the first in each second is recorded in full, the others as"
    " `detail.count` with `first_time` and `last_time` (nanoseconds since the epoch).",
    "message changed": "Monitors changed a message; `detail` has the bytes before and after, `changed_by` the events"
    " that changed it, in order, and `monitor` the monitor of the last event. A record with `count` has `changed_by`"
    " if several monitors changed the message.",
    "monitor fault": "An action of a monitor failed.",
    "monitor log": "A monitor logged a line; the first in each second is recorded in full, and further ones that differ"
    " only in numbers as `detail.count`, with `first_time`, `last_time` (nanoseconds since the epoch), `first_text` and"
    " `last_text` of those. The reason has the last line.",
    "monitor called": "A monitor called a service; if the call fails, `monitor fault` follows.",
    "monitor published": "A monitor published a message.",
    "stop begun": "A monitor stops a topic: it sends its safe message, or puts it in the place of messages. `detail`"
    " has `monitor`, `cause` (its own line, a fault, or why it cannot judge), and what"
    " `message changed` or `monitor published` has of this message; `host` and `caller_id` are those of the message"
    " that led to it, and `publishers` has the nodes that publish the topic if a timer did, or the last one, which has"
    " `ended`.",
    "stop ended": "A stop has ended; `since` and `until` are its first and last action, and `begun_in` is the record of"
    " its begin. With `unknown_end`, control ended during the stop, so `until` is only what it knew.",
    "publication refused": "A publisher or service uses another type definition than the specifications; it is not"
    " relayed.",
    "door added": "An operator added a door.",
    "door removed": "An operator removed a door: its connections and tickets ended.",
    "door ticket made": "A ticket for a door was made.",
    "door connected": "Connections to a door began; `count` is their number in a second.",
    "door disconnected": "Connections to a door ended that had begun; `reason` has that of the last one.",
    "door entry refused": "A connection to a door was refused: its ticket, address or handshake is not valid, or the"
    " door is full; `host` is the peer.",
    "definitions differ": "Two publishers define one type differently with one md5sum, in which ROS leaves out the"
    " brackets of nested messages; `host` and `caller_id` are the later one, `detail` has the earlier.",
    "door failed": "The process of a door ended, or its port could not be listened on.",
    "recording ordered": "A recording was ordered.",
    "recording closed": "The flight recorder finished a recording.",
    "recording fetched": "The messages of a recording were fetched.",
    "recording read": "Messages of a recording were read, decoded.",
    "recording removed": "A recording was removed; `who` is `recorder` if it was removed for space or age,"
    " or if control restarted after the order.",
    "recording missed": "A trigger made no recording: `reason` says why (limit of recordings per hour, or disk space),"
    " or which recording has its time; `detail.recording` is the id that the trigger's record had promised.",
    "topic looked into": "Messages of a topic were shown; the record covers `seconds`.",
    "monitor looked into": "Variables of a monitor were shown. Further requests of the same client are in this record"
    " until none has come for a minute.",
    "rest call": "A REST call was answered; `who` is the token's name.",
    "rest certificate replaced": "REST has another certificate, because the earlier one ended soon or lacked a name."
    " Clients that trust exactly the earlier one refuse it.",
    "evidence exported": "An evidence bundle was made; `manifest` is the hash of its manifest.",
    "order refused": "RVMaster rejected an order over REST: no valid token, role or proof; `detail.verb` is the order.",
    "token added": "An access token for REST was made.",
    "token revoked": "An access token for REST was revoked before its expiry.",
    "token rotated": "An access token for REST replaced the earlier ones of its name; `earlier` has their ids,"
    " `earlier_until` their end.",
    "signed on": "A person signed in at the provider of single sign-on; `subject` is the provider's, `groups` are those"
    " of doors, `id` and `expires` those of the session.",
    "signed off": "A session of a person ended before its time; `who` ended it, and `name` is the person.",
    "sign-on refused": "A sign-on at the provider gave no session; `host` is the browser's address, `reason` says why.",
    "switchover ordered": "An operator ordered the active appliance to hand over to the standby.",
    "switchover failed": "An ordered switchover did not happen; `reason` says why.",
    "process started": "A process of the appliance, in `resource`, started again after an unexpected end.",
    "process died": "A process of the appliance, in `resource`, ended unexpectedly; `reason` has its own words or why"
    " it was killed, `detail.end` the signal or exit status. An end while control was away is recorded once control is"
    " back: the last one of each process. After `process failing`, further ends are not recorded until the process"
    " has run for ten seconds.",
    "process failing": "A process of the appliance ends soon after every start; `reason` says why, `detail.output` has"
    " the last lines that it printed. It is restarted at growing intervals of up to a minute.",
    "appliance started": "The appliance is in service; `configuration` has the start of the SHA-256 of each setting,"
    " `settings` the values of the section `sso`, and `off` all monitors that are not in force, with their states.",
    "appliance stopped": "The appliance was shut down in an orderly way.",
    "took over": "This appliance of a pair became the active one; `checkpoint` is the last one of the other appliance's"
    " log that was replicated (null without one), `previous` the takeover before.",
    "handed over": "This appliance of a pair handed over to the other one in an orderly way; it answers nothing after"
    " this record until it takes over again.",
    "malformed": "A peer sent an invalid request, or a publisher an invalid header; it was rejected for the `reason`"
    " given.",
    "connection opened": "A subscriber or service client is connected through the relay.",
    "connection closed": "A connection through the relay ended.",
    "connection refused": "A connection had no grant or a wrong header, or a publisher refused the appliance's"
    " connection.",
    "limit exceeded": "A peer sent more data, larger messages or faster than the limits allow.",
    "rate limited": "Messages beyond a limit of the policy ([Limits]) were dropped; `rule` has the limit,"
    " `detail.count` the number of messages.",
    "probe failed": "The ROS master was reachable from outside; nodes are not served until it is hidden again.",
    "probe passed": "The ROS master is hidden, or hidden again.",
    "reconciled": "The reconcile loop found and repaired a difference between the wanted and the observed state.",
    "denials folded": "Repetitions of a denial that is already recorded.",
    "repetitions folded": "Repetitions of an allowed read, or of a call that waits for an approval, that is already"
    " recorded, and any repeated records of a host beyond its quota.",
    "log begun": "The first record of a new log; `detail.earlier_log_missing` is set if an earlier log existed.",
    "records removed": "Retention removed old records.",
    "records lost": "The queue was full while the log could not be written.",
    "checkpoint": "The state of the chain up to the preceding record was sealed for signing.",
    "log replaced": "The signer also signed another log, which no operator has set aside: the log was replaced or moved"
    " away. `number` and `hash` are those of its last signed checkpoint. Repeated at each start.",
    "log set aside": "An operator on the machine acknowledged that another log is no longer the present one (`rosrv"
    " audit acknowledge`); `number` and `hash` are those of its last signed checkpoint.",
    "signature refused": "The signer rejected a checkpoint, or its signature is invalid or by another key.",
    "bundle in force": "A bundle of the fleet passed its commit-confirm and is in force; `detail.bundle` names it.",
    "bundle ordered": "An operator let this robot try a bundle that waited for an order; `detail.bundle` names it.",
    "bundle refused": "A bundle of the fleet was refused, or rolled back during commit-confirm; `detail.findings` has"
    " the reasons. The last good one stays in force.",
    "bundle metadata rejected": "The collector serves bundles or metadata that are not accepted: badly signed, expired,"
    " older than known, or for other robots.",
    "fleet not joined": "After a takeover, this appliance of a pair is not in the other one's fleet: both must join.",
    "forwarding failed": "The receiver of the forwarded log was unreachable for ten seconds; records wait in the"
    " appliance.",
    "forwarding resumed": "The receiver of the forwarded log is reachable again.",
    "forwarding gap": "Retention removed records before they were forwarded.",
    "disk nearly full": "Only the reserve (`audit.reserve_bytes`) is free on the log's disk; `reason` says what to do.",
    "disk has room": "More than the reserve is free on the log's disk again.",
    "clock not synchronised": "No time service synchronises the machine's clock; the times of records may be wrong.",
    "clock synchronised": "A time service synchronises the machine's clock again.",
    "clock set forward": "The machine's clock advanced further than the time that passed, by `seconds`.",
    "clock set back": "The machine's clock is earlier than the last record, by `seconds`.",
    "ended by the clock": "The machine's clock ended a token, a ticket or another right (`detail.kind`, its name in"
    " `resource`), which otherwise had `detail.seconds` left: the clock was set forward, or it shows that the appliance"
    " was off for that long.",
    "state directory new": "The appliance started with a new state directory, which has nothing of an earlier one;"
    " `detail.parts` says what that means, `detail.on` and `detail.off` name the monitors.",
    "protection forgotten": "A monitor is disabled or in shadow mode, or a section of the policy audit-only, for"
    " longer than `forgotten_after`; `resource` names it, `reason` says how to enable it again.",
    "adopted": "A registration was taken over from the robot's own master by an operator's order (`rosrv adopt`).",
    "graph adopted": "The robot's graph was taken over from its own master.",
    "graph released": "The robot's graph was given back to its own master.",
    "firewall restored": "Another program had removed rules of the appliance's firewall, which are in force again; `by`"
    " is that program, `seconds` the time without the rules, and `connections` the number of that time that were"
    " ended.",
    "graph restored": "Other machines may have reached the robot's own master; what was registered there was"
    " unregistered again.",
    "adoption failed": "The robot's graph cannot be taken over or given back; `reason` says why. It is tried again.",
    "log failed": "The log could not be written for some time and is written again; `reason` says why.",
}

MONITOR_ACTIONS = frozenset(
    {"message dropped", "message changed", "monitor verdict", "monitor fault", "stop begun"}
)
"""The events of monitors that start a recording if `recorder.triggers` lists them."""

SEVERITIES: dict[str, Severity] = {
    name: severity
    for severity, names in {
        Severity.NOTICE: (
            "approval ended", "approval given", "approval refused", "approval used", "approval wanted",
            "authority asked", "authority handed over", "host block ended", "motion stopped", "host unblocked",
            "appliance started", "appliance stopped", "bundle in force", "bundle ordered", "clock not synchronised",
            "clock synchronised",
            "evidence exported", "forwarding resumed", "handed over", "host awaited", "host awaited no longer",
            "host enrolled", "host renewed", "hosts reloaded", "driver checked", "guard loaded", "heartbeat begun",
            "guard tested", "monitor resumed",
            "monitor set",
            "policy loaded", "rights changed", "stop ended",
            "recording closed", "door added", "door removed", "door ticket made", "signed off", "signed on",
            "recording ordered", "recording fetched", "recording read", "recording removed", "specifications loaded",
            "state directory new", "switchover ordered",
            "token added", "token revoked", "token rotated", "took over", "topic looked into",
            "monitor looked into", "graph adopted", "graph released",
            "tunnel down", "tunnel moved", "tunnel up", "probe passed",
        ),
        Severity.WARNING: (
            "authority refused", "motion not stopped", "bundle metadata rejected", "bundle refused",
            "graph restored",
            "certificate ended", "certificate ends soon", "clock set back", "clock set forward", "ended by the clock",
            "definitions differ", "enrolment refused", "guard late",
            "door entry refused", "door failed", "forwarding failed", "host authority replaced",
            "host blocked", "host revoked", "limit exceeded", "malformed", "packets refused",
            "policy refused", "process died", "recording missed", "renewal refused", "rest certificate replaced",
            "sign-on refused", "specifications refused", "switchover failed", "tunnel refused",
        ),
        Severity.ALARM: (
            "adoption failed", "firewall restored", "fleet not joined", "forwarding gap", "guard bypassed",
            "heartbeat ended", "monitor not built",
            "monitors restarted", "policy file refused", "probe failed", "process failing", "protection forgotten",
            "publication refused", "records lost",
            "topics held",
        ),
    }.items()
    for name in names
}  # fmt: skip
"""The severity of each event for which it is fixed; for other events, the recording code gives it."""
