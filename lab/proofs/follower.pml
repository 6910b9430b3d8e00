/*
 * A follower: another computer of the robot, whose firewall follows the lease of two appliances (features/standby/
 * witness/follower.py). lab/proofs/lease.pml is about the witness and the appliances; here the witness is only what a
 * follower needs of it.
 *
 * The rules:
 *   F1  An answer of the witness is worth a part of the time that its lease has left, counted from the time at which
 *       the request was sent. The rest (MARGIN) allows for the follower's slower clock.
 *   F2  An answer to a request that was sent before that of an accepted answer counts for nothing.
 *   F3  Rules that admit an appliance are abandoned as soon as the newest answer no longer admits it, or its time ends.
 *   F4  When the time of the newest answer ends, the follower begins to shut out both appliances.
 *   F5  The thread that asks does not wait for the one that writes the rules.
 *
 * Checked in every reachable state, for every order of the steps:
 *   fenced  the follower never begins to admit an appliance while the robot admits the other one, unless the first has
 *           given the lease up
 *   newest  it never begins to admit an appliance other than the one of the newest answer
 *   shut    it admits an appliance beyond the time of its answer only while it is already writing other rules
 * and, with SERVED (the holder renews and a request is answered in each tick):
 *   kept    it admits the holder after the time of one write, and from then on, however slow the firewall is
 *
 * Time is counted in ticks, and all times are relative, so the search has no horizon. A lease lasts EXPIRY ticks, a write
 * of rules any number of them up to WRITE, and the follower's clock misses at most one tick in EXPIRY. Requests and
 * answers are late or lost. Two requests are under way at most: of more, only the newest counts. A step that is due
 * (`due`) comes before the next tick.
 *
 * The epochs that a follower saves protect it from a witness that was restored from an old disk; they are not modelled.
 * `lab/tests/proofs/test_follower.py` has the bounds that are checked, and the mutants.
 */

#ifndef EXPIRY
#define EXPIRY 3
#endif
#ifndef WRITE
#define WRITE 4 /* longer than a lease */
#endif
#ifdef MUTANT_NO_MARGIN
#define MARGIN 0
#else
#define MARGIN 1
#endif

#define NOBODY 0 /* appliances are 1 and 2 */
#define SHUT 3   /* the rules that admit nobody, while they are written */

#define FREE 0
#define ASKED 1
#define ANSWERED 2

/* The witness. The robot admits the last holder until the next grant. */
byte holder = NOBODY;
byte lease = 0; /* ticks that are left */
bool gave[3];   /* whether the appliance has given its last lease up */

/* The requests under way. `ticks` is the follower's time since it was sent, and in an answer what that is still worth. */
byte state[2];
byte named[2]; /* the holder in the answer */
byte ticks[2];
bool second;   /* whether request 0 was sent after request 1 */
bool passed[2]; /* whether a request that was sent later has its answer accepted */

/* The follower. */
byte newest = NOBODY;
byte valid = 0;    /* ticks of the follower until the newest answer is worth nothing */
byte writing = SHUT; /* it starts without knowing the rules */
byte wrote = 0;    /* ticks since the write began */
byte steady = 0;   /* ticks of the follower's clock since it missed one */

/* Only for the properties. */
byte admitted = NOBODY; /* by the firewall, whatever the follower knows of it */
byte learnt = NOBODY;   /* in the accepted answer whose request was sent last */
#ifdef SERVED
byte since = 0;         /* ticks since the start */
bool fresh;             /* whether an answer came in this tick */
#endif

/* = appliance/features/standby/witness/follower.py WitnessFollower._wanted */
#define WANTED (valid > 0 -> newest : NOBODY)
#define IS_NAME (writing == 1 || writing == 2)

/* = appliance/features/standby/witness/follower.py WitnessFollower._seconds_left */
#ifdef MUTANT_NOT_ABANDONED
#define ABANDON false
#else
#ifdef MUTANT_OLD_LEASE /* looks at the time, and not at the name */
#define ABANDON (IS_NAME && valid == 0)
#else
#define ABANDON (IS_NAME && WANTED != writing)
#endif
#endif

/* = appliance/features/standby/witness/follower.py WitnessFollower.pause */
#ifdef MUTANT_NEVER_SHUTS
#define BEGIN (writing == NOBODY && admitted != WANTED && WANTED != NOBODY)
#else
#define BEGIN (writing == NOBODY && admitted != WANTED)
#endif

#ifdef MUTANT_ONE_THREAD
#define LISTENS (writing == NOBODY)
#else
#define LISTENS true
#endif

#ifdef SERVED
#define SOON (lease < EXPIRY || LISTENS && (!fresh || state[0] != FREE || state[1] != FREE))
#define MAY_SEND (!fresh)
#else
#define SOON false
#define MAY_SEND true
#endif

#define DUE (ABANDON || BEGIN || (writing != NOBODY && wrote == WRITE) || SOON)

/* = appliance/features/standby/witness/follower.py WitnessFollower.request */
inline send(which) {
  state[which] = ASKED;
  second = (which == 0 && state[1] != FREE)
}

inline answer(which) {
  state[which] = ANSWERED;
#ifdef MUTANT_COUNTED_LATE /* from the time at which the answer is received */
  ticks[which] = 0;
#endif
  ticks[which] = (lease > ticks[which] + MARGIN -> lease - ticks[which] - MARGIN : 0);
  named[which] = (ticks[which] > 0 -> holder : NOBODY)
}

inline drop(which) {
  state[which] = FREE; named[which] = NOBODY; ticks[which] = 0; passed[which] = false; second = false
}

/* = appliance/features/standby/witness/follower.py WitnessFollower.receive */
inline receive(which) {
  newest = named[which]; valid = ticks[which];
#ifdef SERVED
  fresh = true;
#endif
  learnt = (passed[which] -> learnt : newest);
  if
  :: state[1 - which] != FREE && second == (which == 0) -> /* the other one was sent before */
#ifdef MUTANT_OVERTAKEN
    passed[1 - which] = true
#else
    drop(1 - which)
#endif
  :: else
  fi;
  drop(which)
}

/* = appliance/features/standby/witness/follower.py WitnessFollower.enforce */
inline commit() {
  if
  :: IS_NAME ->
    assert(holder == writing || gave[writing]);
    assert(learnt == writing);
    admitted = writing
  :: else -> admitted = NOBODY
  fi;
  writing = NOBODY; wrote = 0
}

inline pass(which) {
  if
  :: state[which] == ASKED -> ticks[which] = (ticks[which] < EXPIRY -> ticks[which] + 1 : EXPIRY)
#ifndef MUTANT_COUNTED_LATE
  :: state[which] == ANSWERED && ticks[which] > 0 ->
    ticks[which]--;
    named[which] = (ticks[which] > 0 -> named[which] : NOBODY)
#endif
  :: else
  fi
}

inline tick() {
  assert(admitted == NOBODY || admitted == WANTED || writing != NOBODY);
#ifdef SERVED
  assert(since <= WRITE + WRITE + 2 || admitted == 1);
  since = (since < 255 -> since + 1 : since);
  fresh = false;
#endif
  lease = (lease > 0 -> lease - 1 : 0);
  wrote = (writing != NOBODY -> wrote + 1 : 0);
  if
  :: steady == EXPIRY -> steady = 0 /* the follower's clock misses this tick */
  :: true ->
    steady = (steady < EXPIRY -> steady + 1 : steady);
    valid = (valid > 0 -> valid - 1 : 0);
    pass(0); pass(1);
    if
    :: valid == 0 -> newest = NOBODY; learnt = NOBODY
    :: else
    fi
  fi
}

init {
#ifdef SERVED
  holder = 1; lease = EXPIRY;
#endif

  do
#ifdef SERVED
  :: atomic { lease < EXPIRY -> lease = EXPIRY }
#else
  :: atomic { holder != NOBODY && lease > 0 -> lease = EXPIRY } /* a renewal */
  :: atomic { holder != NOBODY && lease > 0 -> gave[holder] = true; holder = NOBODY; lease = 0 }
  :: atomic { lease == 0 -> holder = 1; lease = EXPIRY; gave[1] = false }
  :: atomic { lease == 0 -> holder = 2; lease = EXPIRY; gave[2] = false }
  :: atomic { state[0] != FREE -> drop(0) } /* lost */
  :: atomic { state[1] != FREE -> drop(1) }
#endif
  :: atomic { LISTENS && MAY_SEND && state[0] == FREE -> send(0) }
  :: atomic { LISTENS && MAY_SEND && state[1] == FREE -> send(1) }
  :: atomic { state[0] == ASKED -> answer(0) }
  :: atomic { state[1] == ASKED -> answer(1) }
  :: atomic { LISTENS && state[0] == ANSWERED -> receive(0) }
  :: atomic { LISTENS && state[1] == ANSWERED -> receive(1) }
  :: atomic { ABANDON -> writing = SHUT; wrote = 0 } /* the rules that were being written may be in force or not */
  :: atomic { !ABANDON && writing != NOBODY -> commit() }
  :: atomic { BEGIN -> writing = (WANTED == NOBODY -> SHUT : WANTED); wrote = 0 }
  :: atomic { !DUE -> tick() }
  od
}
