/*
 * How RVMaster puts the relay, with its monitors, between publishers and subscribers of a topic.
 *
 * Checked for every order in which these processes can take their steps, for the bounds below:
 *   judged      a message that is sent after a change of the specifications was answered is judged by that revision
 *               or a later one, and once the relay has what it was told, by the one in force (or being tried)
 *   barred      after a change of the policy was answered, no message is passed on to a subscriber, or of a publisher,
 *               from whom it was taken
 *   whole       on one connection no message is lost or comes twice, whatever is loaded, replaced or removed meanwhile
 *   connected   when nothing is under way any more, every subscriber is connected to every publisher that it may have,
 *               and the relay judges by the revision in force
 *
 * A step is one turn of an event loop, as in the program: control and the relay are each one thread that carries out
 * one message after the other. Links between processes keep their order. `=` names what a step models.
 *
 * `lab/tests/proofs/test_insertion.py` has the bounds that are checked, `test_insertion_mutants.py` mutants: each is this text
 * with one thing wrong (a name that begins with `MUTANT` is defined), and Spin finds what comes of it.
 *
 * With TRACE the steps that leave a record are only taken in the order of a trace of the running appliance (`kind`,
 * `first`, `second`, LENGTH), and all others when they like: a trace is one of the model's when its end can be reached
 * (`accepted`). `lab/tests/proofs/test_insertion_traces.py` has such traces, and tampered ones.
 */

#ifndef PUBLISHERS
#define PUBLISHERS 1
#endif
#ifndef SUBSCRIBERS
#define SUBSCRIBERS 1
#endif
#ifndef LOADS
#define LOADS 2        /* changes of the specifications: load, replace, remove */
#endif
#ifndef POLICIES
#define POLICIES 2     /* changes of the policy */
#endif
#ifndef CRASHES
#define CRASHES 1      /* of the relay */
#endif
#ifndef UNDER_WAY
#define UNDER_WAY 1    /* messages on a connection to a publisher; it waits where the relay does not read */
#endif
#ifndef SENDING
#define SENDING true   /* publishers send for ever, as fast as they are read; else nothing, so that all may come to rest */
#endif

#define PAIRS (PUBLISHERS * SUBSCRIBERS)
#define PAIR(p, s) ((p) * SUBSCRIBERS + (s))
#define NUMBERS 3      /* messages are numbered modulo this; fewer are under way */
#define UNKNOWN NUMBERS

mtype = {
    spec, place, withdraw, grant, revoke, found, gone, orders,
    no_answer, taken, refused
};
#define ASKED 1        /* of a spec: control waits for the answer */
#define AHEAD 2        /* of a spec: before anything else is carried out */

chan to_relay = [14] of { mtype, byte, byte };

/* What the relay has said and control has not come to yet. Control does another thing for each, so their order means
   nothing; answers that control does not wait for do nothing, and are left out. */
mtype said = no_answer;                                          /* to the spec that was asked */
bool orders_done;

/* What subscribers are told: lists of publishers, a bit for each. */
chan news[SUBSCRIBERS] = [6] of { byte };

/* A connection of a subscriber to the port that stands for a publisher. */
#define NONE 0
#define KNOCKED 1      /* in the queue of the listening socket, or waiting to be judged */
#define OPEN 2
byte connection[PAIRS];

/* requestTopic of a subscriber, on its way in control. */
#define NOT 0
#define CALLED 1
#define DECIDED 2
byte request[PAIRS];

/* The connection of the relay to a publisher: a message is its number and the revision that was answered when it was sent. */
chan upstream[PUBLISHERS] = [UNDER_WAY] of { byte, byte };
byte next_number[PUBLISHERS];

/* Control. */
bool published[PUBLISHERS], subscribed[SUBSCRIBERS];
bool came_p[PUBLISHERS], came_s[SUBSCRIBERS];                    /* the node has made its one registration */
bool shelved_p[PUBLISHERS], shelved_s[SUBSCRIBERS];              /* the policy took it back, and may give it again */
bool may_publish[PUBLISHERS], may_subscribe[SUBSCRIBERS];        /* the policy in force */
bool granted[PAIRS];
byte in_force, trying, latest;                                   /* revisions of the specifications; 0: none */
bool monitored[LOADS + 2];                                       /* of a revision: it has a monitor on the topic */
bool taken_by_relay[LOADS + 2];                                  /* of a revision: the relay can compile it */
bool waiting;                                                    /* for the relay's answer to what is tried */
bool linked;                                                     /* the link to the relay stands */
bool lost;                                                       /* it has ended, and control has not come to it yet */
bool ordering;                                                   /* a change of the policy waits for the relay */
byte loads, policies, crashes;

/* The relay. */
bool up;
byte has;                                                        /* the revision that judges; 0: nothing was stated */
bool blocked;                                                    /* the first could not be taken: nothing goes on */
bool awaited;                                                    /* nothing is carried out until it is compiled */
chan compiling = [4] of { byte, byte };
bool placed[PUBLISHERS], listening[PUBLISHERS], allowed[PAIRS];  /* the table of what control stated */
bool through[PUBLISHERS];                                        /* messages go through the monitors, else past them */
byte decided[PUBLISHERS];                                        /* by which revision that was decided */
byte prepared[PUBLISHERS];                                       /* the revision that the lane has prepared; 0: none */
bool flowing[PUBLISHERS];                                        /* the connection to the publisher */
byte asked[PUBLISHERS];                                          /* control, where it is */
#define ASKING 1
#define ANSWERED 2

/* A step is the next of the trace, and has happened. */
#ifdef TRACE
byte at;
mtype = { publication, subscription, decided_call, loaded, revoked, opened, closed, heard };
hidden mtype kind[LENGTH];
hidden byte first[LENGTH], second[LENGTH];
chan reports = [6] of { mtype };                                 /* what the relay has said of connections */
#define NEXT_IS(what, a, b) (at < LENGTH && kind[at] == what && first[at] == (a) && second[at] == (b))
/* It is the next, or this way comes to an end here: nothing takes a step any more. */
#define HAPPENS(what, a, b) \
    if \
    :: NEXT_IS(what, a, b) -> at++ \
    :: else -> at = LENGTH + 1 \
    fi
#define POSSIBLE provided (at <= LENGTH)
#define REPORT(what) reports!what
#else
#define HAPPENS(what, a, b) skip
#define POSSIBLE
#define REPORT(what) skip
#endif

/* Only for what is asserted. */
byte answered;                                                   /* the revision that operators were last told of */
bool barred[PAIRS];                                              /* taken, and operators were told so */
byte last[PAIRS];                                                /* the number that the subscriber had last */

#if SUBSCRIBERS > 1
#define connected_to(p) (connection[PAIR(p, 0)] == OPEN || connection[PAIR(p, 1)] == OPEN)
#else
#define connected_to(p) (connection[PAIR(p, 0)] == OPEN)
#endif

#define TELL(message, a, b) \
    if \
    :: linked -> assert(nfull(to_relay)); to_relay!message(a, b) \
    :: else \
    fi
/* = appliance/specifications/rollout.py Rollout._answer */
#ifdef MUTANT_ANY_ANSWER
#define ANSWERS(revision, how) (waiting && (how) & ASKED)
#else
#define ANSWERS(revision, how) (waiting && (how) & ASKED && revision == trying)
#endif
#define SAY(answer, revision, how) \
    if \
    :: ANSWERS(revision, how) -> said = answer \
    :: else \
    fi

hidden byte i, j, list, number, flags;                           /* for the length of one step */

/* --- control: what subscribers are told ------------------------------------------------------------------- */

/* = appliance/master/reconcile/subscribers.py Subscribers._state */
inline tell(s) {
    list = 0;
    for (i : 0 .. PUBLISHERS - 1) {
        if
        :: published[i] -> list = list | (1 << i)
        :: else
        fi
    }
    assert(nfull(news[s]));
    news[s]!list
}

/* = appliance/master/reconcile/subscribers.py Subscribers.flush */
inline tell_all() {
    for (j : 0 .. SUBSCRIBERS - 1) {
        if
        :: subscribed[j] -> tell(j)
        :: else
        fi
    }
}

/* --- control: grants -------------------------------------------------------------------------------------- */

/* = appliance/master/graph/graph.py Grants.take */
inline take_grant(p, s) {
    if
    :: granted[PAIR(p, s)] -> granted[PAIR(p, s)] = false; TELL(revoke, p, s)
    :: else
    fi
}

/* --- control: specifications ------------------------------------------------------------------------------ */

/* = appliance/specifications/rollout.py Rollout._settle */
inline settle() {
    HAPPENS(loaded, trying, monitored[trying]);
    in_force = trying;
    trying = 0;
    waiting = false;
    said = no_answer;
    TELL(spec, in_force, 0);
    answered = in_force
}

/* = appliance/specifications/rollout.py Rollout.take */
inline take_back_trial() {
    trying = 0;
    waiting = false;
    said = no_answer;
    TELL(spec, in_force, 0)
}

/* --- control: the policy ---------------------------------------------------------------------------------- */

/* = appliance/control/assembly/policies.py Policies.reload */
inline answer_policy() {
    ordering = false;
    orders_done = false;
    for (i : 0 .. PUBLISHERS - 1) {
        for (j : 0 .. SUBSCRIBERS - 1) {
            barred[PAIR(i, j)] = !(may_publish[i] && may_subscribe[j])
        }
    }
}

/* = appliance/master/graph/graph.py RosGraph.revoked */
inline revoke_publication(p) {
    may_publish[p] = false;
    if
    :: published[p] ->
        HAPPENS(revoked, 0, 0);
        published[p] = false; shelved_p[p] = true; TELL(withdraw, p, 0); tell_all()
    :: else
    fi
}

/* = appliance/master/graph/graph.py RosGraph._give_up
   = appliance/master/reconcile/subscribers.py Subscribers._wanted
   = appliance/master/graph/revocation.py Revocation._revoke */
inline revoke_subscription(s) {
    may_subscribe[s] = false;
    for (i : 0 .. PUBLISHERS - 1) { take_grant(i, s) }
    if
    :: subscribed[s] ->
        HAPPENS(revoked, 0, 0);
        subscribed[s] = false; shelved_s[s] = true;
        assert(nfull(news[s]));
        news[s]!0
    :: else
    fi
}

/* = appliance/master/graph/graph.py RosGraph.granted_again
   = appliance/master/graph/revocation.py Revocation.returned */
inline give_publication(p) {
    may_publish[p] = true;
    for (j : 0 .. SUBSCRIBERS - 1) { barred[PAIR(p, j)] = barred[PAIR(p, j)] && !may_subscribe[j] }
    if
    :: shelved_p[p] -> HAPPENS(publication, 0, 0); shelved_p[p] = false; published[p] = true; TELL(place, p, 0); tell_all()
    :: else
    fi
}

/* = appliance/master/reconcile/subscribers.py Subscribers.flush */
inline give_subscription(s) {
    may_subscribe[s] = true;
    for (j : 0 .. PUBLISHERS - 1) { barred[PAIR(j, s)] = barred[PAIR(j, s)] && !may_publish[j] }
    if
    :: shelved_s[s] -> HAPPENS(subscription, 0, 0); shelved_s[s] = false; subscribed[s] = true; tell(s)
    :: else
    fi
}


/* --- the relay: monitors ---------------------------------------------------------------------------------- */

/* = appliance/relay/data_plane.py DataPlane._attach_monitors */
inline let_monitor(p) {
    through[p] = blocked || monitored[has];
    decided[p] = has
}

/* = appliance/relay/data_plane.py DataPlane._monitors_changed
   = appliance/relay/monitors/interceptor.py Interceptor.invalidate_prepared */
inline monitors_changed() {
    for (i : 0 .. PUBLISHERS - 1) {
#ifndef MUTANT_STALE_LANE
        prepared[i] = 0;
#endif
#ifndef MUTANT_DECIDED_ONCE
        if
        :: placed[i] -> let_monitor(i)
        :: else
        fi;
#endif
        skip
    }
}

/* A set of monitors takes the place of the one before, between two messages.
   = appliance/relay/monitors/interceptor.py Interceptor.loaded */
inline swap(revision, how) {
    has = revision;
    blocked = false;
    awaited = awaited && !(how & AHEAD);
    monitors_changed();
#ifdef MUTANT_SWAP_RECONNECTS
    for (i : 0 .. PUBLISHERS - 1) {
        do
        :: len(upstream[i]) > 0 -> upstream[i]?_, _
        :: else -> break
        od
    }
#endif
    SAY(taken, revision, how)
}

/* --- the relay: connections ------------------------------------------------------------------------------- */

/* = appliance/relay/data_plane.py DataPlane._remove_topic
   = appliance/relay/connections/relayed_topic.py RelayedTopic.cut_all */
inline remove_topic(p) {
    placed[p] = false;
    flowing[p] = false;
    asked[p] = NOT;
    through[p] = false;
    decided[p] = 0;
    prepared[p] = 0;
    do
    :: len(upstream[p]) > 0 -> upstream[p]?_, _
    :: else -> break
    od;
    for (j : 0 .. SUBSCRIBERS - 1) {
        if
        :: connection[PAIR(p, j)] == OPEN ->
            connection[PAIR(p, j)] = NONE; last[PAIR(p, j)] = UNKNOWN; REPORT(closed)
        :: else
        fi
    }
}

/* = appliance/relay/connections/relayed_topic.py RelayedTopic._pass_on
   = appliance/relay/connections/subscriber.py Subscriber.deliver */
inline pass_on(p, sequence, sent_under, judge) {
    for (j : 0 .. SUBSCRIBERS - 1) {
        if
        :: connection[PAIR(p, j)] == OPEN ->
            assert(!barred[PAIR(p, j)]);                          /* barred */
            assert(judge >= sent_under);                          /* judged */
            if
            :: linked && len(compiling) == 0 && !(to_relay??[spec, _, _]) && taken_by_relay[in_force] ->
                assert(judge == in_force || judge == trying)      /* judged */
            :: else
            fi;
            assert(last[PAIR(p, j)] == UNKNOWN || sequence == (last[PAIR(p, j)] + 1) % NUMBERS); /* whole */
            last[PAIR(p, j)] = sequence
        :: else
        fi
    }
}

#define AS_BEFORE (has && !blocked && len(compiling) == 0 && number == has)

/* = appliance/relay/data_plane.py DataPlane._carry_out */
inline carry_out() {
    to_relay?message, number, flags;
    if
    /* = appliance/relay/monitors/interceptor.py Interceptor.state
       = appliance/relay/monitors/loader.py Loader.later */
    :: message == spec ->
        if
        :: AS_BEFORE -> SAY(taken, number, flags)
        :: !AS_BEFORE && (has || blocked) ->
#ifdef MUTANT_SWAP_IN_TWO
            for (i : 0 .. PUBLISHERS - 1) { through[i] = false; decided[i] = 0 }
#endif
            awaited = awaited || (flags & AHEAD);
            assert(nfull(compiling));
            compiling!number, flags
        :: !has && !blocked && len(compiling) == 0 && !monitored[number] -> swap(number, flags)
        :: !has && !blocked ->
            awaited = true;
            assert(nfull(compiling));
            compiling!number, flags | AHEAD
        fi
    /* = appliance/relay/data_plane.py DataPlane._state
       = appliance/relay/data_plane.py DataPlane._place_topic */
    :: message == place ->
        listening[number] = true;
        if
        :: !placed[number] -> placed[number] = true; let_monitor(number)
        :: else
        fi
    /* = appliance/relay/data_plane.py DataPlane._withdrawn */
    :: message == withdraw -> remove_topic(number)
    /* = appliance/relay/grant_table.py GrantTable.state */
    :: message == grant -> allowed[PAIR(number, flags)] = true
    /* = appliance/relay/grant_table.py GrantTable.withdraw
       = appliance/relay/data_plane.py DataPlane._cut_by
       = appliance/relay/connections/subscriber.py Subscriber.cut */
    :: message == revoke ->
        allowed[PAIR(number, flags)] = false;
#ifndef MUTANT_REVOKED_NOT_CUT
        if
        :: connection[PAIR(number, flags)] == OPEN ->
            connection[PAIR(number, flags)] = NONE; last[PAIR(number, flags)] = UNKNOWN; REPORT(closed)
        :: else
        fi
#endif
    /* = appliance/relay/data_plane.py DataPlane._upstream_answered
       = appliance/relay/connections/upstream.py PublisherConnection.found
       = appliance/relay/connections/upstream.py PublisherConnection._flow */
    :: message == found ->
        if
        :: asked[number] == ANSWERED ->
            asked[number] = NOT; flowing[number] = true;
            for (j : 0 .. SUBSCRIBERS - 1) { last[PAIR(number, j)] = UNKNOWN }
        :: else
        fi
    /* = appliance/relay/connections/upstream.py PublisherConnection.refused */
    :: message == gone -> asked[number] = NOT
    :: message == orders -> orders_done = true
    fi;
    message = 0
}

/* --- the nodes -------------------------------------------------------------------------------------------- */

proctype Publisher(byte me) POSSIBLE {
end:
    do
    /* It registers, once: a turn of control.
       = appliance/master/calls/registration.py RegistrationCalls.register_publisher
       = appliance/master/graph/graph.py RosGraph.registered
       = appliance/master/endpoints/relay_control.py RelayControl.flush */
    :: atomic {
        !came_p[me] -> came_p[me] = true;
        if
        :: may_publish[me] -> HAPPENS(publication, 0, 0); published[me] = true; TELL(place, me, 0); tell_all()
        :: else
        fi
       }
    /* It publishes: what is sent goes to whoever is connected, and waits where the relay does not read. */
    :: atomic {
        SENDING && flowing[me] && nfull(upstream[me]) ->
        upstream[me]!next_number[me], answered;
        next_number[me] = (next_number[me] + 1) % NUMBERS
       }
    od
}

proctype Subscriber(byte me) POSSIBLE {
end:
    do
    /* It registers, once: a turn of control; the answer has its list.
       = appliance/master/calls/registration.py RegistrationCalls.register_subscriber
       = appliance/master/reconcile/subscribers.py Subscribers.list_for */
    :: atomic {
        !came_s[me] -> came_s[me] = true;
        if
        :: may_subscribe[me] -> HAPPENS(subscription, 0, 0); subscribed[me] = true; tell(me)
        :: else
        fi
       }
    /* It is told a list (publisherUpdate): it drops whom the list has no more, and asks whom it is not connected to.
       = appliance/master/endpoints/delivery.py Delivery.push */
    :: atomic {
        news[me]?list ->
        for (i : 0 .. PUBLISHERS - 1) {
            if
#ifdef TRACE
            :: !(list & (1 << i)) && connection[PAIR(i, me)] == OPEN -> connection[PAIR(i, me)] = NONE; REPORT(closed)
#endif
            :: !(list & (1 << i)) -> connection[PAIR(i, me)] = NONE; last[PAIR(i, me)] = UNKNOWN
            :: (list & (1 << i)) && connection[PAIR(i, me)] != OPEN && !request[PAIR(i, me)] ->
                request[PAIR(i, me)] = CALLED
            :: else
            fi
        };
        list = 0
       }
    od
}

/* A subscriber's requestTopic to the outer face of a publisher, and its connection to the port of the answer. */
proctype Request(byte p; byte s) POSSIBLE {
end:
    do
    /* = appliance/master/calls/call_execution.py Execution._decide */
    :: atomic {
        request[PAIR(p, s)] == CALLED ->
        if
        :: published[p] && may_subscribe[s] ->
            HAPPENS(decided_call, 0, 0); request[PAIR(p, s)] = DECIDED
        :: else -> request[PAIR(p, s)] = NOT
        fi
       }
    /* The grant is on the link before the subscriber has its answer. What a policy took back that came into force
       since it was decided is taken back now.
       = appliance/master/calls/node_calls.py NodeCalls.request_topic
       = appliance/master/graph/graph.py RosGraph.topic_granted
       = appliance/master/calls/call_execution.py Execution._carry_out
       = appliance/master/graph/revocation.py Revocation.redecide_for */
    :: atomic {
        request[PAIR(p, s)] == DECIDED ->
        request[PAIR(p, s)] = NOT;
        if
        :: published[p] ->
            granted[PAIR(p, s)] = true;
            TELL(grant, p, s);
#ifndef MUTANT_NOT_REDECIDED
            if
            :: !may_subscribe[s] -> take_grant(p, s)
            :: else
            fi;
#endif
            if
            :: connection[PAIR(p, s)] == NONE -> connection[PAIR(p, s)] = KNOCKED
            :: else
            fi
        :: else
        fi
       }
    /* The relay takes the connection, when it has carried out what control has told it. Who lacks something that is
       held back waits.
       = appliance/relay/data_plane.py DataPlane._on_introduction
       = appliance/relay/transport/loop_channel.py LoopLink.catch_up
       = appliance/relay/connections/admission.py missing
       = appliance/relay/data_plane.py DataPlane._subscribe */
    :: atomic {
        up && (awaited || len(to_relay) == 0) && listening[p] && connection[PAIR(p, s)] == KNOCKED ->
        if
        :: placed[p] && allowed[PAIR(p, s)] ->
            connection[PAIR(p, s)] = OPEN; last[PAIR(p, s)] = UNKNOWN; REPORT(opened)
        :: (!placed[p] || !allowed[PAIR(p, s)]) && !awaited -> connection[PAIR(p, s)] = NONE
        :: else
        fi
       }
    od
}

/* --- control ---------------------------------------------------------------------------------------------- */

inline find_upstream(p) {
    asked[p] = ANSWERED;
    if
    :: published[p] -> TELL(found, p, 0)
    :: else -> TELL(gone, p, 0)
    fi
}

/* What the relay says.
   = appliance/master/endpoints/relay_control.py RelayControl._on_message */
proctype RVMaster() POSSIBLE {
end:
    do
    /* = appliance/specifications/rollout.py Rollout._taken */
    :: atomic { said == taken && waiting -> settle() }
    /* = appliance/specifications/rollout.py Rollout._refused */
    :: atomic { said == refused && waiting -> take_back_trial() }
    /* = appliance/master/endpoints/relay_control.py RelayControl._find_upstream */
    :: atomic { asked[0] == ASKING -> find_upstream(0) }
#if PUBLISHERS > 1
    :: atomic { asked[1] == ASKING -> find_upstream(1) }
#endif
    :: atomic { orders_done -> answer_policy() }
    /* = appliance/specifications/rollout.py Rollout.lost */
    :: atomic {
        lost -> lost = false;
        if
        :: waiting -> take_back_trial()
        :: else
        fi
       }
#ifdef TRACE
    /* = appliance/master/endpoints/traffic.py RelayTraffic.opened
       = appliance/master/endpoints/traffic.py RelayTraffic.closed */
    :: atomic { reports?[opened] && NEXT_IS(opened, 0, 0) -> reports?opened; at++ }
    :: atomic { reports?[closed] && NEXT_IS(closed, 0, 0) -> reports?closed; at++ }
    /* = appliance/master/reconcile/reminders.py Reminders._remind */
    :: atomic { linked && subscribed[0] && len(news[0]) == 0 && connection[0] == NONE && !request[0] -> tell(0) }
#endif
    /* The relay does not answer in time.
       = appliance/specifications/rollout.py Rollout._findings */
    :: atomic { waiting -> take_back_trial() }
    od
}

/* Monitors are loaded, replaced and removed, one change after the other.
   = appliance/specifications/specification_manager.py SpecificationManager._changed
   = appliance/specifications/rollout.py Rollout._try */
proctype Specifications() POSSIBLE {
end:
    do
    :: atomic {
        loads < LOADS && !trying -> loads++; latest++; trying = latest;
        if
        :: monitored[latest] = true
        :: monitored[latest] = false
        fi;
        if
        :: taken_by_relay[latest] = true
#ifdef REFUSING
        :: taken_by_relay[latest] = false
#endif
        fi;
#ifdef MUTANT_ANSWERED_BEFORE_TAKEN
        answered = latest;
#endif
        if
        :: linked -> waiting = true; TELL(spec, latest, ASKED)
        :: else -> settle()
        fi
       }
    od
}

/* The policy is changed: one node's right is taken or given.
   = appliance/control/assembly/policies.py Policies.reload
   = appliance/master/reconcile/sinks.py Enforcement.policy_changed */
proctype Policy() POSSIBLE {
    byte who;
end:
    do
    :: atomic {
        policies < POLICIES && !ordering -> policies++;
        who = 0;
        if
        :: do
            :: who < PUBLISHERS - 1 -> who++
            :: break
            od;
            if
            :: may_publish[who] -> revoke_publication(who)
            :: else -> give_publication(who)
            fi
        :: do
            :: who < SUBSCRIBERS - 1 -> who++
            :: break
            od;
            if
            :: may_subscribe[who] -> revoke_subscription(who)
            :: else -> give_subscription(who)
            fi
        fi;
        who = 0;
#ifdef MUTANT_ANSWERED_BEFORE_CUT
        answer_policy()
#else
        if
        :: linked -> ordering = true; TELL(orders, 0, 0)
        :: else -> answer_policy()
        fi
#endif
       }
    od
}

/* --- the relay -------------------------------------------------------------------------------------------- */

#ifdef MUTANT_NOT_AWAITED
#define HOLDS_NOTHING_BACK true
#else
#define HOLDS_NOTHING_BACK !awaited
#endif

/* = appliance/relay/data_plane.py DataPlane.take */
proctype Relay() POSSIBLE {
    mtype message;
end:
    do
    :: atomic {
        up && HOLDS_NOTHING_BACK && len(to_relay) > 0 -> carry_out()
       }
    /* = appliance/relay/monitors/loader.py Loader._ready */
    :: atomic {
        up && len(compiling) > 0 -> compiling?number, flags;
        if
        :: taken_by_relay[number] -> swap(number, flags)
        /* = appliance/relay/monitors/interceptor.py Interceptor._refuse */
        :: else ->
            awaited = awaited && !(flags & AHEAD);
            if
            :: !has -> blocked = true
            :: else
            fi;
            monitors_changed();
            SAY(refused, number, flags)
        fi
       }
    od
}

/* A topic of one publisher, in the relay. */
proctype Topic(byte p) POSSIBLE {
    byte sequence, sent_under, judge;
end:
    do
    /* = appliance/relay/connections/upstream.py PublisherConnection.connect
       = appliance/relay/connections/upstream.py PublisherConnection.ask */
    :: atomic {
        up && placed[p] && !flowing[p] && asked[p] == NOT && (through[p] || connected_to(p)) ->
        asked[p] = ASKING
       }
    /* = appliance/relay/connections/relayed_topic.py RelayedTopic.received
       = appliance/relay/monitors/topic_pipeline.py TopicPipeline.through
       = appliance/relay/monitors/topic_pipeline.py TopicPipeline._prepare */
    :: atomic {
        up && flowing[p] && len(upstream[p]) > 0 ->
#ifdef MUTANT_GIVEN_AGAIN
        if
        :: len(compiling) > 0 -> upstream[p]?<sequence, sent_under>
        :: else -> upstream[p]?sequence, sent_under
        fi;
#else
        upstream[p]?sequence, sent_under;
#endif
        judge = decided[p];
        if
        :: through[p] && !blocked ->
            if
            :: !prepared[p] -> prepared[p] = has
            :: else
            fi;
            judge = prepared[p]
        :: else
        fi;
        if
        :: through[p] && blocked
        :: else ->
            pass_on(p, sequence, sent_under, judge);
#ifdef TRACE
            if
            :: true    /* one of which the trace says nothing */
            :: connection[PAIR(p, 0)] == OPEN && NEXT_IS(heard, judge, sent_under) -> at++
            fi
#endif
        fi;
        sequence = 0; sent_under = 0; judge = 0;
        /* Only differences of numbers mean anything: they begin again. */
        if
        :: len(upstream[p]) == 0 ->
            next_number[p] = 0;
            for (j : 0 .. SUBSCRIBERS - 1) {
                if
                :: last[PAIR(p, j)] != UNKNOWN -> last[PAIR(p, j)] = NUMBERS - 1
                :: else
                fi
            }
        :: else
        fi
       }
    od
}

/* The relay dies, and is started again; control states everything afresh.
   = appliance/supervisor/process_handle.py ProcessHandle */
proctype Supervisor() POSSIBLE {
#ifdef MUTANT_STATED_LATER
    bool later;
#endif
end:
    do
    :: atomic {
        up && crashes < CRASHES -> crashes++;
        up = false; linked = false; lost = true; said = no_answer; orders_done = false;
        has = 0; blocked = false; awaited = false;
        do
        :: len(to_relay) > 0 -> to_relay?_, _, _
        :: len(compiling) > 0 -> compiling?_, _
        :: else -> break
        od;
        for (i : 0 .. PUBLISHERS - 1) {
            remove_topic(i);
            listening[i] = false;
            for (j : 0 .. SUBSCRIBERS - 1) {
                allowed[PAIR(i, j)] = false;
                /* Who waited to be judged is gone, who waited to be taken is not: the port stays. */
                if
                :: connection[PAIR(i, j)] == KNOCKED -> connection[PAIR(i, j)] = NONE
                :: true
                fi
            }
        };
#ifdef TRACE
        do
        :: len(reports) > 0 -> reports?_
        :: else -> break
        od;
#endif
        if
        :: ordering -> answer_policy()
        :: else
        fi
       }
    /* = appliance/master/endpoints/relay_control.py RelayControl.attach
       = appliance/specifications/rollout.py Rollout.statement
       = appliance/master/endpoints/relay_control.py RelayControl._state_node
       = appliance/control/process.py SupervisorMessages._relay_link
       = appliance/master/reconcile/subscribers.py Subscribers.remind_all */
    :: atomic {
        !up -> up = true; linked = true; lost = false;
#ifdef MUTANT_STATED_LATER
        later = true;
#else
        TELL(spec, (trying -> trying : in_force), AHEAD);
#endif
        for (i : 0 .. PUBLISHERS - 1) {
            if
            :: published[i] -> TELL(place, i, 0)
            :: else
            fi;
            for (j : 0 .. SUBSCRIBERS - 1) {
                if
                :: granted[PAIR(i, j)] -> TELL(grant, i, j)
                :: else
                fi
            }
        };
#ifndef MUTANT_NOBODY_REMINDED
        tell_all()
#endif
       }
#ifdef MUTANT_STATED_LATER
    :: atomic { later -> later = false; TELL(spec, (trying -> trying : in_force), AHEAD) }
#endif
    od
}

#ifdef TRACE
proctype Rest() POSSIBLE {
    at == LENGTH -> assert(!true)    /* accepted */
}
#else
/* Nothing is under way any more. */
proctype Rest() POSSIBLE {
    timeout ->
    for (i : 0 .. PUBLISHERS - 1) {
        for (j : 0 .. SUBSCRIBERS - 1) {
            assert(!(published[i] && subscribed[j]) || (connection[PAIR(i, j)] == OPEN && flowing[i]))
        }
    };
    assert(!taken_by_relay[in_force] || has == in_force);
    assert(!trying && !ordering)
}
#endif

init {
    atomic {
        in_force = 1; latest = 1; answered = 1;
#ifdef TRACE
        fill_trace();
#endif
        if
        :: monitored[1] = true
        :: monitored[1] = false
        fi;
        if
        :: taken_by_relay[1] = true
#ifdef REFUSING
        :: taken_by_relay[1] = false
#endif
        fi;
        for (i : 0 .. PUBLISHERS - 1) { may_publish[i] = true; run Publisher(i); run Topic(i) };
        for (j : 0 .. SUBSCRIBERS - 1) { may_subscribe[j] = true; run Subscriber(j) };
        for (i : 0 .. PUBLISHERS - 1) {
            for (j : 0 .. SUBSCRIBERS - 1) { last[PAIR(i, j)] = UNKNOWN; run Request(i, j) }
        };
        run RVMaster(); run Specifications(); run Policy(); run Relay(); run Supervisor(); run Rest()
    }
}
