/*
 * The lease of an appliance and its standby, with a witness on the robot that grants it and enforces it.
 *
 * The rules:
 *   R1  The witness grants the lease to X only if the lease has expired and X is in the in-sync set. A grant increments
 *       the epoch on disk, and then changes the robot's firewall to admit X alone.
 *   R2  The holder removes the other appliance from the in-sync set, and has the witness's answer, before it
 *       acknowledges a write alone. It counts the other in from the time at which it asks to add it back.
 *   R3  The holder is active while it hears the witness (a renewal) or the standby (a promise not to claim). Both are
 *       valid for 0.8 of an expiry from the time at which the holder asked; renewal and promise last a whole expiry
 *       from the time at which they were given. An appliance that has promised does not claim, and does not become
 *       active by an earlier claim, until its promise is over. One that starts waits as long as if it had promised.
 *       A standby gives no promise while the witness tells it that the lease has expired.
 *   R4  A reboot of the robot shuts out both appliances until the holder renews, or until the next grant. The epoch,
 *       the holder and the in-sync set are read from disk. After each start the witness grants nothing for one expiry.
 *   R5  Every appliance keeps the greatest epoch that it has heard of on its disk. It follows, and promises to, only a
 *       holder of that epoch or a later one; an active appliance that hears of a later epoch becomes passive.
 *   R6  A write is on the disk of an appliance before the appliance counts as having it.
 *
 * Checked in every reachable state, for every order of the steps:
 *   fenced   the robot never admits both appliances
 *   whole    the robot never admits an appliance that lacks an acknowledged write
 *   single   never do both appliances pass the check that comes before each answer: active, and within 0.8 of an expiry
 *   growing  the epoch of the witness only grows
 * and, with LAST_FAULT, from every reachable state:
 *   served   ROUNDS expiries after the last fault, and from then on, one appliance is admitted, active, reaches the
 *            robot, and can acknowledge writes, if an appliance of the in-sync set is up and reaches the robot
 *
 * `single` is about the check. An answer that was checked, and then delayed by a pause of the process, can leave later.
 * The robot rejects it. Other hosts can get it: a stale answer to a query. An acknowledgement is safe at any time, so
 * the model acknowledges without the check.
 *
 * Faults, in any number and order: a message is lost or late (a partition loses all messages of its links); an
 * appliance crashes, is started, or is paused for any time (it takes no step, but its time passes); the witness crashes
 * and is started; the robot reboots, also between the two halves of a grant; power cuts, which are all of these
 * together; a switchover. Only the number of grants is bounded, by GRANTS. Writes have no bound: only the one that is
 * not acknowledged yet is distinguished.
 *
 * Time has no numbers. A period may end at any time, however short or long, with two exceptions: the lease expires at
 * the witness only after the holder's 0.8 of every renewal, including one whose answer is still in flight; and a
 * promise ends only after the other's 0.8 of it. This is sound, that is, it includes every real execution, if the
 * appliance counts from the time at which it asked, which is not later than the time at which the other one starts to
 * count; if the rates of two clocks differ by less than a fifth; and if the appliance's clock continues while it sleeps
 * (CLOCK_BOOTTIME). Clocks are never compared. A switchover needs no message here: once the holder is passive, the
 * lease may expire.
 *
 * Requests are numbered by the appliance and carry the witness's boot nonce, so the witness drops a request that was
 * overtaken by a later one, and the appliance drops the answer to one. So one exchange of each appliance with the
 * witness is in flight; another begins when that one is lost. A renewal and a promise go through in one step, and
 * only their answers are in flight: a late request means less time for the holder, and time has no numbers.
 *
 * `lab/tests/proofs/test_lease.py` has the bounds that are checked, `test_lease_mutants.py` the mutants.
 *
 * With TRACE the steps that leave an event are taken only in the order of a trace (`kind`, `first`, `second`, LENGTH),
 * and all others at any time. `lab/proofs/lease_traces.py` defines the events.
 */

#ifndef GRANTS
#define GRANTS 3
#endif
#ifndef ROUNDS
#define ROUNDS 4
#endif

#define OTHER(x) (1 - (x))
#define BIT(x) (1 << (x))
#define NOBODY 2

/* The witness. On its disk: */
byte epoch, holder = NOBODY, in_sync = 3;
/* In its memory: */
bool serving = true;           /* its process runs */
bool running = true;           /* the lease has not expired; true for one expiry after its start */
bool granting;                 /* a grant is on disk, and not in the firewall yet */
/* In the robot's firewall, until it reboots: */
byte admits;

/* An appliance. On its disk: */
byte term[2];                  /* the greatest epoch that it has heard of; its own, if it is active */
bool whole[2] = true;          /* it has every acknowledged write */
/* In its memory: */
bool up[2] = true;
bool leads[2];
bool partner[2];               /* the other may be in the in-sync set, so it must have each acknowledged write */
bool writing[2];               /* a write is stored, and not acknowledged */
bool synced[2];                /* the other has everything that this one has stored */
/* Periods. They end whether the appliance takes steps or not. */
bool leased[2];                /* 0.8 of an expiry since it asked for its last renewal */
bool trusted[2];               /* 0.8 of an expiry since it asked for the last promise of the other */
bool promise[2] = true;        /* one expiry since it gave a promise, or was started */

/* The exchange of an appliance with the witness. */
mtype = { none, claim, remove, add, held, denied };
mtype wire[2] = none;
byte wire_epoch[2];            /* of an answer: the witness's epoch */
bool wire_other[2];            /* of an answer: the other is in the in-sync set */
bool fresh[2];                 /* of an answer: 0.8 of an expiry since the request is not over */
bool orphan[2];                /* of a request: who sent it has crashed */
bool offered[2];               /* the answer with a promise is in flight, and as fresh */

#ifdef MUTANT_OVERTAKEN
bool late;                     /* a request to add the other comes after a later request */
#endif
bool calm;                     /* the last fault has happened */
byte seen;                     /* only for what is asserted: the greatest epoch of the witness */

/* A step with an event is possible only if its event is the next of the trace. */
#ifdef TRACE
short at;
mtype = {
    granted, renewed, released, refused, removed, added, promised, activated, passive, crashed, started, rebooted,
    acknowledged
};
hidden mtype kind[LENGTH];
hidden byte first[LENGTH], second[LENGTH];
#define EVENT(what, a, b) (at < LENGTH && kind[at] == what && first[at] == (a) && second[at] == (b))
#define LOGGED at++
byte shown[2];                 /* the epoch under which the trace shows the appliance as active; 0: passive */
#define SHOWN(x) shown[x]
#define UNLESS_TRACED(condition) true
#else
#define EVENT(what, a, b) true
#define LOGGED skip
#define SHOWN(x) false
#define UNLESS_TRACED(condition) (condition)
#endif
#define POSSIBLE provided (!calm)

/* The check that comes before each answer. */
#ifdef MUTANT_NO_LIMIT
#define IN_TIME(x) true
#else
#define IN_TIME(x) (leased[x] || trusted[x])
#endif
#define ANSWERS(x) (up[x] && leads[x] && IN_TIME(x))

#ifdef MUTANT_NOT_EXPIRED
#define EXPIRED true
#else
#define EXPIRED !running
#endif
#ifdef MUTANT_ANY_APPLIANCE
#define IN_SYNC(x) true
#else
#define IN_SYNC(x) (in_sync & BIT(x))
#endif

#ifdef MUTANT_RENEWAL_FROM_ANSWER
#define OWN_LIMIT_OVER(x) !leased[x]
#else
#define OWN_LIMIT_OVER(x) (!leased[x] && !(wire[x] == held && fresh[x]))
#endif

/* --- an appliance ----------------------------------------------------------------------------------------- */

/* = appliance/features/standby/lease.py ApplianceLease._learn */
inline make_passive(x) {
    leads[x] = false;
    leased[x] = false; trusted[x] = false; offered[x] = false;
    partner[x] = false; writing[x] = false; synced[x] = false
}

/* It hears of a later epoch.
 = appliance/features/standby/lease.py ApplianceLease.follow */
inline hear_epoch(x, e) {
    if
    :: e > term[x] -> term[x] = e
    :: else
    fi
}

/* It has an answer that it holds the lease.
 = appliance/features/standby/lease.py ApplianceLease.answered */
inline hold(x, e, other_in_sync) {
    leads[x] = true; leased[x] = true;
    term[x] = e; partner[x] = other_in_sync
}

/* The other one installs everything that x has stored. */
inline copy_from(x) {
    whole[OTHER(x)] = whole[x]; synced[x] = true;
    term[OTHER(x)] = term[x]
}

/* = appliance/features/standby/lease.py ApplianceLease.received */
inline give_promise(x) {
    promise[OTHER(x)] = true; offered[x] = true;
    term[OTHER(x)] = term[x]
}

#ifdef MUTANT_ACTIVE_DESPITE_PROMISE
#define MAY_ACTIVATE(x) fresh[x]
#else
#define MAY_ACTIVATE(x) (fresh[x] && !promise[x])
#endif
#ifdef MUTANT_STALE_STREAM
#define FOLLOWS(y, x) (up[y] && !leads[y])
#else
#define FOLLOWS(y, x) (up[y] && !leads[y] && term[y] <= term[x])
#endif

/* = appliance/features/standby/lease.py ApplianceLease.tick */
proctype Appliance(byte me) POSSIBLE {
end:
    do
    /* It claims the lease. */
    :: atomic { up[me] && wire[me] == none && !promise[me] && !leased[me] -> wire[me] = claim }
    /* R2: it removes the other, or adds it back. */
    :: atomic { up[me] && wire[me] == none && leads[me] && partner[me] -> wire[me] = remove }
#ifdef MUTANT_ADDED_EARLY
    :: atomic {
        up[me] && wire[me] == none && leads[me] && !partner[me] ->
#else
    :: atomic {
        up[me] && wire[me] == none && leads[me] && !partner[me] && synced[me] ->
#endif
        wire[me] = add;
#ifndef MUTANT_COUNTED_LATE
        partner[me] = true
#endif
       }
    /* It has an answer of the witness. */
    :: atomic {
        up[me] && wire[me] == held && leads[me] ->
        wire[me] = none;
        term[me] = wire_epoch[me]; partner[me] = wire_other[me];
        leased[me] = leased[me] || fresh[me];
        fresh[me] = false; wire_epoch[me] = 0; wire_other[me] = false
       }
    :: atomic {
        up[me] && wire[me] == held && !leads[me] && MAY_ACTIVATE(me) ->
        wire[me] = none;
        hold(me, wire_epoch[me], wire_other[me]);
        fresh[me] = false; wire_epoch[me] = 0; wire_other[me] = false
       }
    :: atomic {
        up[me] && wire[me] == denied && !SHOWN(me) ->
        wire[me] = none;
        hear_epoch(me, wire_epoch[me]);
        wire_epoch[me] = 0;
        if
        :: leads[me] -> make_passive(me)
        :: else
        fi
       }
    /* It hears of a later epoch from the other. */
    :: atomic {
        up[me] && up[OTHER(me)] && term[OTHER(me)] > term[me] && !SHOWN(me) ->
        term[me] = term[OTHER(me)];
        if
        :: leads[me] -> make_passive(me)
        :: else
        fi
       }
    /* R3: it asks the other for a promise, which the other gives. */
    :: atomic {
        up[me] && leads[me] && !offered[me] && up[OTHER(me)] && !leads[OTHER(me)] && term[OTHER(me)] <= term[me] ->
        give_promise(me)
       }
    :: atomic {
        up[me] && leads[me] && offered[me] && EVENT(promised, OTHER(me), me) ->
        LOGGED; offered[me] = false; trusted[me] = true
       }
#ifdef TRACE
    :: atomic { up[me] && EVENT(promised, OTHER(me), me) -> LOGGED }    /* too late, or twice */
    :: atomic { EVENT(passive, me, 0) && shown[me] -> LOGGED; shown[me] = 0 }
    :: atomic { EVENT(activated, me, term[me]) && ANSWERS(me) && shown[me] != term[me] -> LOGGED; shown[me] = term[me] }
#endif
    /* It has heard neither for 0.8 of an expiry, or hands over: as ordered, or if only the other reaches the robot. */
    :: atomic {
        up[me] && leads[me] && (synced[me] || !IN_TIME(me)) && !SHOWN(me) ->
#ifdef MUTANT_HANDS_OVER_ACTIVE
        running = false
#else
        make_passive(me)
#endif
       }
    /* A write: stored, sent to the other, acknowledged. */
    :: atomic { ANSWERS(me) && !writing[me] -> writing[me] = true; synced[me] = false }
    :: atomic { up[me] && leads[me] && !synced[me] && FOLLOWS(OTHER(me), me) -> copy_from(me) }
#ifdef MUTANT_ALONE_UNASKED
    :: atomic {
        up[me] && leads[me] && writing[me] && EVENT(acknowledged, me, 0) ->
#else
    :: atomic {
        up[me] && leads[me] && writing[me] && (synced[me] || !partner[me]) && EVENT(acknowledged, me, 0) ->
#endif
        LOGGED;
        writing[me] = false;
        whole[OTHER(me)] = whole[OTHER(me)] && synced[me]
       }
    od
}

/* --- the witness ------------------------------------------------------------------------------------------ */

/* It answers who asked; one that has crashed since gets nothing. */
inline answer_held(x) {
    if
    :: orphan[x] -> wire[x] = none
    :: else -> wire[x] = held; wire_epoch[x] = epoch; wire_other[x] = (in_sync >> OTHER(x)) & 1; fresh[x] = true
    fi;
    orphan[x] = false
}

/* An answer without news is none. */
inline answer_denied(x) {
    if
    :: !orphan[x] && epoch > term[x] -> wire[x] = denied; wire_epoch[x] = epoch
    :: else -> wire[x] = none
    fi;
    orphan[x] = false
}

/* R1: on disk.
 = appliance/features/standby/witness/lease_rules.py Witness._claim */
inline grant(x) {
#ifndef MUTANT_SAME_EPOCH
    epoch++;
#endif
    seen = epoch;
    holder = x; running = true; granting = true
}

/* R1: in the firewall.
 = appliance/features/standby/witness/lease_rules.py Witness._enforce */
inline admit_holder() {
    granting = false;
#ifdef MUTANT_NOT_FENCED
    admits = admits | BIT(holder)
#else
    admits = BIT(holder)
#endif
}

#ifdef MUTANT_ANYBODY_REMOVES
#define MAY_REMOVE(x) true
#else
#define MAY_REMOVE(x) (holder == x)
#endif
/* It admits the holder again, if the robot has rebooted.
 = appliance/features/standby/witness/lease_rules.py Witness._renew */
inline renew(x) {
    running = true;
#ifndef MUTANT_RENEWED_SHUT
    admits = BIT(x)
#endif
}

/* = appliance/features/standby/witness/lease_rules.py Witness.handle */
proctype Witness() POSSIBLE {
    byte x;
end:
    do
    :: atomic {
        serving && !granting ->
        if
        :: x = 0
        :: x = 1
        fi;
        if
        /* It renews, or answers that another holds the lease. */
        :: up[x] && wire[x] == none && holder == x && EVENT(renewed, x, epoch) -> LOGGED; renew(x); answer_held(x)
        :: up[x] && wire[x] == none && holder != x && epoch > term[x] -> answer_denied(x)
        :: wire[x] == claim && holder == x && EVENT(renewed, x, epoch) -> LOGGED; renew(x); answer_held(x)
        /* R1. */
        :: wire[x] == claim && EXPIRED && IN_SYNC(x) && epoch < GRANTS -> grant(x)
        :: wire[x] == claim && !(EXPIRED && IN_SYNC(x)) && holder != x -> answer_denied(x)
        /* R2. */
        :: wire[x] == remove && MAY_REMOVE(x) && EVENT(removed, x, epoch) ->
            LOGGED; in_sync = in_sync & ~BIT(OTHER(x)); running = true; answer_held(x)
        :: wire[x] == add && holder == x && EVENT(added, x, epoch) ->
            LOGGED; in_sync = 3; running = true; answer_held(x)
        :: (wire[x] == remove || wire[x] == add) && holder != x -> answer_denied(x)
#ifdef TRACE
        /* It refuses: 1 because another holds the lease, 2 who is not in the in-sync set, 0 for a reason of its own. */
        :: EVENT(refused, x, 0) || (EVENT(refused, x, 1) && holder != x) ||
            (EVENT(refused, x, 2) && !(in_sync & BIT(x))) ->
            LOGGED; answer_denied(x)
        :: EVENT(released, x, epoch) && holder == x && OWN_LIMIT_OVER(x) -> LOGGED; running = false
#endif
        fi;
        x = 0
       }
    :: atomic {
        granting && EVENT(granted, holder, epoch) ->
        LOGGED;
        admit_holder();
        if
        :: wire[holder] == claim -> answer_held(holder)
        :: else
        fi
       }
#ifdef TRACE
    /* The firewall did not accept the rules, and the disk did not take the record back. */
    :: atomic { granting && EVENT(refused, holder, 0) -> LOGGED; granting = false }
#endif
#ifdef MUTANT_OVERTAKEN
    :: atomic { late && holder == 0 -> late = false; in_sync = 3 }
#endif
    od
}

/* --- time ------------------------------------------------------------------------------------------------- */

#ifdef MUTANT_PROMISE_FROM_ANSWER
#define LIMIT_OF_OTHER_OVER(x) !trusted[OTHER(x)]
#else
#define LIMIT_OF_OTHER_OVER(x) (!trusted[OTHER(x)] && !offered[OTHER(x)])
#endif

proctype Time() POSSIBLE {
end:
    do
    :: atomic { leased[0] && (trusted[0] || !SHOWN(0)) -> leased[0] = false }
    :: atomic { leased[1] && (trusted[1] || !SHOWN(1)) -> leased[1] = false }
    :: atomic { trusted[0] && (leased[0] || !SHOWN(0)) -> trusted[0] = false }
    :: atomic { trusted[1] && (leased[1] || !SHOWN(1)) -> trusted[1] = false }
    :: atomic { fresh[0] -> fresh[0] = false }
    :: atomic { fresh[1] -> fresh[1] = false }
    :: atomic { offered[0] -> offered[0] = false }
    :: atomic { offered[1] -> offered[1] = false }
    :: atomic { up[0] && promise[0] && LIMIT_OF_OTHER_OVER(0) -> promise[0] = false }
    :: atomic { up[1] && promise[1] && LIMIT_OF_OTHER_OVER(1) -> promise[1] = false }
    :: atomic {
        serving && running && !granting && (holder == NOBODY || OWN_LIMIT_OVER(holder)) -> running = false
       }
    od
}

/* --- faults ----------------------------------------------------------------------------------------------- */

/* Requests carry the boot nonce of the witness: a new one drops them. */
inline drop_requests() {
    for (i : 0 .. 1) {
        if
        :: wire[i] == claim || wire[i] == remove || wire[i] == add -> wire[i] = none; orphan[i] = false
        :: else
        fi
    }
}

/* The witness may have carried out a request when it crashes, and not have logged it. */
inline finish_request() {
#ifdef TRACE
    if
    :: serving && wire[0] == remove && holder == 0 -> in_sync = 1
    :: serving && wire[1] == remove && holder == 1 -> in_sync = 2
    :: serving && holder != NOBODY && wire[holder] == add -> in_sync = 3
    :: true
    fi
#else
    skip
#endif
}

inline lose(x) {
    wire[x] = none; orphan[x] = false;
    fresh[x] = false; wire_epoch[x] = 0; wire_other[x] = false
}

inline crash(x) {
#ifdef TRACE
    shown[x] = 0;
#endif
    up[x] = false; make_passive(x); promise[x] = true;
#ifdef MUTANT_NOT_ON_DISK
    whole[x] = whole[x] && !synced[OTHER(x)];
#endif
#ifdef MUTANT_EPOCH_FORGOTTEN
    term[x] = 0;
#endif
    if
    :: wire[x] == held || wire[x] == denied -> lose(x)
    :: wire[x] == claim || wire[x] == remove || wire[x] == add -> orphan[x] = true
    :: else
    fi
}

hidden byte i;                 /* for the length of one step */

proctype Faults() POSSIBLE {
    byte x;
end:
    do
    /* A message is lost. */
    :: atomic { wire[0] != none -> lose(0) }
    :: atomic { wire[1] != none -> lose(1) }
#ifdef MUTANT_OVERTAKEN
    :: atomic { wire[0] == add -> wire[0] = none; orphan[0] = false; late = true }
#endif
    /* An appliance crashes and is started, maybe by hand. */
    :: atomic { up[0] && EVENT(crashed, 0, 0) -> LOGGED; crash(0) }
    :: atomic { up[1] && EVENT(crashed, 1, 0) -> LOGGED; crash(1) }
    :: atomic {
        !up[0] && EVENT(started, 0, 0) ->
        LOGGED; up[0] = true;
#ifdef MUTANT_STARTED_CLAIMING
        promise[0] = false;
#endif
#ifdef MUTANT_STARTED_ACTIVE
        leads[0] = true; leased[0] = true; partner[0] = true;
#endif
       }
    :: atomic { !up[1] && EVENT(started, 1, 0) -> LOGGED; up[1] = true }
    /* The process of the witness crashes and is started. */
    :: atomic {
        UNLESS_TRACED(serving) && EVENT(crashed, 2, 0) ->
        LOGGED; finish_request(); serving = false; running = true; granting = false; drop_requests()
       }
    :: atomic {
        !serving && EVENT(started, 2, 0) ->
        LOGGED; serving = true;
#ifdef MUTANT_STARTED_EXPIRED
        running = false;
#endif
        if
        :: admits && holder != NOBODY -> admit_holder()
        :: else
        fi
       }
    /* R4: the robot reboots. */
    :: atomic {
        UNLESS_TRACED(serving || admits) && EVENT(rebooted, 2, 0) ->
        LOGGED; finish_request(); serving = false; running = true; granting = false; drop_requests();
#ifdef MUTANT_BOOTS_OPEN
        admits = 3;
#else
        admits = 0;
#endif
#ifdef MUTANT_SET_FORGOTTEN
        in_sync = 3;
#endif
#ifdef MUTANT_WITNESS_EPOCH_FORGOTTEN
        epoch = 0;
#endif
       }
    od
}

/* --- what is asserted ------------------------------------------------------------------------------------- */

proctype Observer() POSSIBLE {
end:
    do
    :: atomic { epoch < seen -> assert(epoch >= seen) }
    :: atomic { admits == 3 -> assert(admits != 3) }
    :: atomic { (admits & 1 && !whole[0]) || (admits & 2 && !whole[1]) -> assert(whole[0] && whole[1]) }
    :: atomic { ANSWERS(0) && ANSWERS(1) -> assert(!leads[0] || !leads[1]) }
#ifdef TRACE
    :: at == LENGTH -> assert(!true)    /* accepted */
#endif
    od
}

/* --- after the last fault --------------------------------------------------------------------------------- */

#ifdef LAST_FAULT
/* The last fault leaves each link up or down for good, and each appliance up or not. Then an expiry is long enough for
   some exchanges, and a period that is not renewed in it ends. Here the appliances do all that they can do, in one
   order or the other; they do not write. */

bool near[2];                  /* the appliance and the robot reach each other */
bool between;                  /* the appliances reach each other */
bool expired_there[2];         /* the witness's last answer: the lease has expired */
hidden byte now_leased[2], now_trusted[2], now_promise[2], now_running;    /* renewed in this expiry */
hidden byte turns;

#define CAN_ASK(x) (near[x] && holder == x)
#define ACKNOWLEDGES(x) (!partner[x] || (between && up[OTHER(x)]))
#define SERVES(x) (up[x] && near[x] && leads[x] && leased[x] && admits == BIT(x) && ACKNOWLEDGES(x))
#define CAN_SERVE(x) (up[x] && near[x] && in_sync & BIT(x))

inline ask_witness(x) {
    expired_there[x] = near[x] && !running && holder != x;
    if
    :: near[x] && holder != x ->
        if
        :: epoch > term[x] && leads[x] -> make_passive(x)
        :: else
        fi;
        hear_epoch(x, epoch);
        if
        :: !promise[x] && !running && in_sync & BIT(x) -> grant(x); admit_holder(); now_running = true
        :: else
        fi
    :: else
    fi;
    if
    :: near[x] && holder == x && (leads[x] || !promise[x]) ->
        renew(x); now_running = true;
        hold(x, epoch, (in_sync >> OTHER(x)) & 1); now_leased[x] = true
    :: near[x] && holder == x && !leads[x] && promise[x] -> hear_epoch(x, epoch)
    :: else
    fi
}

inline ask_other(x) {
    if
    :: leads[x] && between && up[OTHER(x)] && term[OTHER(x)] > term[x] -> make_passive(x); hear_epoch(x, term[OTHER(x)])
    :: leads[x] && between && up[OTHER(x)] && term[OTHER(x)] <= term[x] ->
        if
        :: leads[OTHER(x)] -> make_passive(OTHER(x))
        :: else
        fi;
        copy_from(x);
#ifdef MUTANT_PROMISES_ALWAYS
        if
        :: true ->
#else
        if
        :: !expired_there[OTHER(x)] ->
#endif
            promise[OTHER(x)] = true; now_promise[OTHER(x)] = true; trusted[x] = true; now_trusted[x] = true
        :: else
        fi;
        if
        :: !partner[x] && CAN_ASK(x) -> partner[x] = true; in_sync = 3
        :: else
        fi
    :: leads[x] && !(between && up[OTHER(x)]) && partner[x] && CAN_ASK(x) ->
#ifndef MUTANT_NEVER_REMOVES
        partner[x] = false; in_sync = BIT(x)
#endif
    :: else
    fi
}

inline turn(x) {
    if
    :: up[x] -> ask_witness(x); ask_other(x)
    :: else
    fi
}

/* An expiry ends. */
inline end_periods(x) {
    leased[x] = leased[x] && now_leased[x]; now_leased[x] = false;
    trusted[x] = trusted[x] && now_trusted[x]; now_trusted[x] = false;
    promise[x] = promise[x] && now_promise[x]; now_promise[x] = false;
    if
    :: leads[x] && !IN_TIME(x) -> make_passive(x)
    :: else
    fi
}

proctype LastFault() {
    byte x, rounds;
    atomic {
        !granting && serving && !offered[0] && !offered[1] && wire[0] == none && wire[1] == none ->
        calm = true;
        seen = 0;
        if
        :: up[0] = true
        :: true
        fi;
        if
        :: up[1] = true
        :: true
        fi;
        if
        :: near[0] = true
        :: true
        fi;
        if
        :: near[1] = true
        :: true
        fi;
        if
        :: between = true
        :: true
        fi
    };
    if
    :: !CAN_SERVE(0) && !CAN_SERVE(1) -> goto over
    :: else
    fi;
    do
    :: rounds < ROUNDS + 2 ->
        atomic {
            if
            :: x = 0
            :: x = 1
            fi;
            for (turns : 1 .. 3) { turn(x); turn(OTHER(x)) }
            end_periods(0); end_periods(1);
            running = running && now_running; now_running = false;
            x = 0; rounds++;
            if
            :: rounds >= ROUNDS -> assert(SERVES(0) || SERVES(1))
            :: else
            fi
        }
    :: else -> break
    od;
over:
    skip
}
#endif

init {
    atomic {
#ifdef TRACE
        fill_trace();
        epoch = FIRST; seen = FIRST;
        if
        :: in_sync = 1
        :: in_sync = 2
        :: in_sync = 3
        fi;
        if
        :: up[0] = false
        :: true
        fi;
        if
        :: up[1] = false
        :: true
        fi;
        if
        :: serving = false
        :: true
        fi;
#endif
        run Appliance(0); run Appliance(1); run Witness(); run Time(); run Faults(); run Observer();
#ifdef LAST_FAULT
        run LastFault();
#endif
        skip
    }
}
