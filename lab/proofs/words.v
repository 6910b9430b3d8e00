(* The checks of `ere` and `fsm` automata are sound: what they accept gives, after every trace, the verdict of the definition.

   `check_words` and `check_machine` are `_check_words` and `_check_machine` (without time limits) of
   rosmop/certify/check.py. Both follow what the definition leaves beside the automaton, through all pairs that
   can be reached (`follow`): of an expression its derivatives (`Words` of words.py there), of a machine the states as
   they are written. `lang` is the definition of expressions; nothing of the check is in it. A trace is the list of its
   events, the first one first. Extracted, and compared with the Python (lab/tests/proofs/test_certifier.py). *)

Require Import List Bool Arith Lia.
Import ListNotations.

(* Something beside an automaton *)

Section Beside.
  Variable S : Type.
  Variable same : forall s t : S, {s = t} + {s <> t}.
  Variable step : S -> nat -> S.
  Variable events : nat.
  Variable table : list (list nat).
  Variable right : S -> nat -> bool.

  Definition target (q e : nat) : nat := nth e (nth q table []) 0.
  Definition after (p : S * nat) (e : nat) : S * nat := (step (fst p) e, target (snd p) e).
  Definition fine (p : S * nat) : bool :=
    (length (nth (snd p) table []) =? events) && forallb (fun e => right (fst (after p e)) (snd (after p e))) (seq 0 events).

  Definition same_pair : forall p q : S * nat, {p = q} + {p <> q}.
  Proof. decide equality. apply Nat.eq_dec. Defined.

  Fixpoint follow (fuel : nat) (waiting seen : list (S * nat)) : bool :=
    match fuel, waiting with
    | 0, _ => false
    | Datatypes.S _, [] => true
    | Datatypes.S fuel, p :: waiting =>
        if in_dec same_pair p seen then follow fuel waiting seen
        else if fine p then follow fuel (map (after p) (seq 0 events) ++ waiting) (p :: seen)
        else false
    end.

  Definition closed (seen waiting : list (S * nat)) : Prop :=
    forall p, In p seen -> fine p = true /\ forall e, e < events -> In (after p e) (seen ++ waiting).

  Lemma follow_closed : forall fuel waiting seen, closed seen waiting -> follow fuel waiting seen = true ->
    exists all, incl (seen ++ waiting) all /\ closed all [].
  Proof.
    induction fuel as [| fuel IH]; intros waiting seen C H; [discriminate |].
    destruct waiting as [| p waiting]; simpl in H.
    - exists seen. rewrite app_nil_r. split; auto. apply incl_refl.
    - destruct (in_dec same_pair p seen) as [I | I].
      + destruct (IH waiting seen) as (all & A & B); auto.
        * intros q Q. destruct (C q Q) as [F N]. split; auto. intros e E. specialize (N e E).
          rewrite in_app_iff in *. destruct N as [N | [-> | N]]; auto.
        * exists all. split; auto. intros q Q. apply A. rewrite in_app_iff in *. destruct Q as [Q | [-> | Q]]; auto.
      + destruct (fine p) eqn:F; [| discriminate].
        destruct (IH (map (after p) (seq 0 events) ++ waiting) (p :: seen)) as (all & A & B); auto.
        * intros q [-> | Q].
          -- split; auto. intros e E. rewrite !in_app_iff. right. left. apply in_map. apply in_seq. lia.
          -- destruct (C q Q) as [G N]. split; auto. intros e E. specialize (N e E).
             rewrite !in_app_iff in *. simpl in *. tauto.
        * exists all. split; auto. intros q Q. apply A. rewrite !in_app_iff in *. simpl in *. tauto.
  Qed.

  Definition known (e : nat) : Prop := e < events.
  Definition run (q : nat) (w : list nat) : nat := fold_left target w q.
  Definition left (s : S) (w : list nat) : S := fold_left step w s.

  (* After every trace but the empty one, what is left and the state of the automaton are right for each other. *)
  Lemma follow_right : forall fuel s q, follow fuel [(s, q)] [] = true ->
    forall w, Forall known w -> w <> [] -> right (left s w) (run q w) = true.
  Proof.
    intros fuel s q H. destruct (follow_closed _ _ _ (fun p (N : In p []) => match N with end) H) as (all & A & C).
    assert (R : forall w t, In t all -> Forall known w -> In (left (fst t) w, run (snd t) w) all).
    { induction w as [| e w IH]; intros [u k] I F; simpl; auto. inversion F; subst. destruct (C _ I) as [_ N].
      specialize (N e H2). rewrite app_nil_r in N. apply (IH _ N H3). }
    intros w F N. destruct (exists_last N) as (before & e & ->). apply Forall_app in F. destruct F as [F G].
    inversion G; subst. assert (I : In (s, q) all) by (apply A; simpl; auto).
    destruct (C _ (R before _ I F)) as [D _]. unfold fine in D. apply andb_prop in D. destruct D as [_ D].
    rewrite forallb_forall in D. specialize (D e). rewrite in_seq in D. unfold left, run. rewrite !fold_left_app. simpl.
    apply D. unfold known in H2. simpl in *. lia.
  Qed.
End Beside.

(* Machines as they are written: where each event leads from each state, and what each state tells *)

Section Machine.
  Variable events : nat.
  Variable written : list (list nat).
  Variable tells : list (list nat).
  Variable begins : nat.
  Variable table : list (list nat).
  Variable verdicts : list (list nat).

  Definition told_right (s q : nat) : bool :=
    match nth_error tells s, nth_error verdicts q with
    | Some t, Some v => if list_eq_dec Nat.eq_dec v t then true else false
    | _, _ => false
    end.

  Definition check_machine (fuel start : nat) : bool :=
    follow nat Nat.eq_dec (target written) events table told_right fuel [(begins, start)] [].

  Theorem check_machine_sound : forall fuel start, check_machine fuel start = true ->
    forall w, Forall (known events) w -> w <> [] ->
    exists t, nth_error tells (run written begins w) = Some t /\ nth_error verdicts (run table start w) = Some t.
  Proof.
    intros fuel start H w F N. pose proof (follow_right _ _ _ _ _ _ _ _ _ H w F N) as R. unfold told_right in R.
    change (left nat (target written) begins w) with (run written begins w) in R.
    destruct (nth_error tells _) as [t |]; [| discriminate]. destruct (nth_error verdicts _) as [v |]; [| discriminate].
    destruct (list_eq_dec Nat.eq_dec v t); [subst; eauto | discriminate].
  Qed.
End Machine.

(* Expressions *)

Inductive word :=
  | Empty
  | Epsilon
  | Event (e : nat)
  | Seq (r s : word)
  | Or (r s : word)
  | And (r s : word)
  | Not (r : word)
  | Star (r : word).

Inductive many (L : list nat -> Prop) : list nat -> Prop :=
  | none : many L []
  | more : forall u v, L u -> many L v -> many L (u ++ v).

Fixpoint lang (r : word) (w : list nat) : Prop :=
  match r with
  | Empty => False
  | Epsilon => w = []
  | Event e => w = [e]
  | Seq r s => exists u v, w = u ++ v /\ lang r u /\ lang s v
  | Or r s => lang r w \/ lang s w
  | And r s => lang r w /\ lang s w
  | Not r => ~ lang r w
  | Star r => many (lang r) w
  end.

Fixpoint nullable (r : word) : bool :=
  match r with
  | Empty | Event _ => false
  | Epsilon | Star _ => true
  | Seq r s | And r s => nullable r && nullable s
  | Or r s => nullable r || nullable s
  | Not r => negb (nullable r)
  end.

Definition same_word : forall r s : word, {r = s} + {r <> s}.
Proof. repeat decide equality. Defined.

(* What is written in another order, or twice, is made the same: so there are few derivatives. Any order would do. *)

Fixpoint rank (r : word) : list nat :=
  match r with
  | Empty => [0]
  | Epsilon => [1]
  | Event e => [2; e]
  | Seq r s => 3 :: rank r ++ rank s
  | Or r s => 4 :: rank r ++ rank s
  | And r s => 5 :: rank r ++ rank s
  | Not r => 6 :: rank r
  | Star r => 7 :: rank r
  end.

Fixpoint before (a b : list nat) : bool :=
  match a, b with
  | [], _ => true
  | _, [] => false
  | x :: a, y :: b => if x =? y then before a b else x <? y
  end.

Fixpoint join (r s : word) : word :=
  match s with
  | Or t u => if same_word r t then s else if before (rank r) (rank t) then Or r s else Or t (join r u)
  | _ => if same_word r s then s else if before (rank r) (rank s) then Or r s else Or s r
  end.

Definition one_more (r s : word) : word :=
  match s with Empty => r | Not Empty => s | _ => join r s end.

Fixpoint either (r s : word) : word :=
  match r with
  | Empty => s
  | Not Empty => r
  | Or t u => either t (either u s)
  | _ => one_more r s
  end.

Fixpoint meet (r s : word) : word :=
  match s with
  | And t u => if same_word r t then s else if before (rank r) (rank t) then And r s else And t (meet r u)
  | _ => if same_word r s then s else if before (rank r) (rank s) then And r s else And s r
  end.

Definition one_less (r s : word) : word :=
  match s with Empty => s | Not Empty => r | _ => meet r s end.

Fixpoint both (r s : word) : word :=
  match r with
  | Empty => r
  | Not Empty => s
  | And t u => both t (both u s)
  | _ => one_less r s
  end.

Definition next (r s : word) : word :=
  match r with Empty => Empty | Epsilon => s | _ => Seq r s end.

Fixpoint derive (r : word) (e : nat) : word :=
  match r with
  | Empty | Epsilon => Empty
  | Event x => if x =? e then Epsilon else Empty
  | Seq r s => if nullable r then either (next (derive r e) s) (derive s e) else next (derive r e) s
  | Or r s => either (derive r e) (derive s e)
  | And r s => both (derive r e) (derive s e)
  | Not r => Not (derive r e)
  | Star t => next (derive t e) r
  end.

Lemma join_lang : forall r s w, lang (join r s) w <-> lang r w \/ lang s w.
Proof.
  intros r s w. revert r. induction s; intros r; simpl join;
    repeat match goal with |- context [if ?c then _ else _] => destruct c end; subst; simpl; try tauto.
  rewrite IHs2. tauto.
Qed.

Lemma one_more_lang : forall r s w, lang (one_more r s) w <-> lang r w \/ lang s w.
Proof. intros r [ | | | | | | [ | | | | | | | ] | ] w; unfold one_more; rewrite ?join_lang; simpl; tauto. Qed.

Lemma either_lang : forall r s w, lang (either r s) w <-> lang r w \/ lang s w.
Proof.
  induction r; intros s w; try (apply one_more_lang); simpl either.
  - simpl. tauto.
  - rewrite IHr1, IHr2. simpl. tauto.
  - destruct r; try (apply one_more_lang). simpl. tauto.
Qed.

Lemma meet_lang : forall r s w, lang (meet r s) w <-> lang r w /\ lang s w.
Proof.
  intros r s w. revert r. induction s; intros r; simpl meet;
    repeat match goal with |- context [if ?c then _ else _] => destruct c end; subst; simpl; try tauto.
  rewrite IHs2. tauto.
Qed.

Lemma one_less_lang : forall r s w, lang (one_less r s) w <-> lang r w /\ lang s w.
Proof. intros r [ | | | | | | [ | | | | | | | ] | ] w; unfold one_less; rewrite ?meet_lang; simpl; tauto. Qed.

Lemma both_lang : forall r s w, lang (both r s) w <-> lang r w /\ lang s w.
Proof.
  induction r; intros s w; try (apply one_less_lang); simpl both.
  - simpl. tauto.
  - rewrite IHr1, IHr2. simpl. tauto.
  - destruct r; try (apply one_less_lang). simpl. tauto.
Qed.

Lemma next_lang : forall r s w, lang (next r s) w <-> exists u v, w = u ++ v /\ lang r u /\ lang s v.
Proof.
  intros r s w. destruct r; try reflexivity; simpl.
  - split; [tauto | intros (u & v & _ & N & _); destruct N].
  - split.
    + intros H. exists [], w. auto.
    + intros (u & v & -> & -> & H). exact H.
Qed.

Lemma nullable_lang : forall r, nullable r = true <-> lang r [].
Proof.
  induction r; simpl; rewrite ?andb_true_iff, ?orb_true_iff, ?negb_true_iff; try (split; (tauto || discriminate)); try tauto.
  - rewrite IHr1, IHr2. split.
    + intros [A B]. exists [], []. auto.
    + intros (u & v & H & A & B). symmetry in H. apply app_eq_nil in H. destruct H as [-> ->]. auto.
  - rewrite <- IHr. destruct (nullable r); split; congruence.
  - split; auto. constructor.
Qed.

Lemma many_first : forall L e w, many L (e :: w) <-> exists u v, w = u ++ v /\ L (e :: u) /\ many L v.
Proof.
  intros L e w. split.
  - intros H. remember (e :: w) as x eqn:E. induction H; [discriminate |].
    destruct u as [| a u]; simpl in E; auto. injection E as -> <-. eauto.
  - intros (u & v & -> & A & B). change (many L ((e :: u) ++ v)). now constructor.
Qed.

Lemma derive_lang : forall r e w, lang (derive r e) w <-> lang r (e :: w).
Proof.
  induction r; intros a w; simpl.
  - tauto.
  - split; [tauto | discriminate].
  - destruct (Nat.eqb_spec e a); simpl.
    + subst. split; congruence.
    + split; [tauto | congruence].
  - assert (Q : (exists u v, w = u ++ v /\ lang r1 (a :: u) /\ lang r2 v) \/ (lang r1 [] /\ lang r2 (a :: w)) <->
        exists u v, a :: w = u ++ v /\ lang r1 u /\ lang r2 v).
    { split.
      - intros [(u & v & -> & A & B) | [A B]].
        + exists (a :: u), v. auto.
        + exists [], (a :: w). auto.
      - intros ([| b u] & v & E & A & B); simpl in E.
        + subst v. auto.
        + injection E as <- ->. left. eauto. }
    assert (P : lang (next (derive r1 a) r2) w <-> exists u v, w = u ++ v /\ lang r1 (a :: u) /\ lang r2 v).
    { rewrite next_lang. split; intros (u & v & E & A & B); exists u, v; rewrite IHr1 in *; auto. }
    rewrite <- Q. rewrite <- nullable_lang. destruct (nullable r1).
    + rewrite either_lang, P, IHr2. tauto.
    + rewrite P. split; [tauto | intros [H | [H _]]; [exact H | discriminate]].
  - rewrite either_lang, IHr1, IHr2. tauto.
  - rewrite both_lang, IHr1, IHr2. tauto.
  - rewrite IHr. tauto.
  - rewrite next_lang, many_first. split; intros (u & v & E & A & B); exists u, v; rewrite IHr in *; auto.
Qed.

Lemma left_lang : forall w v r, lang (left word derive r w) v <-> lang r (w ++ v).
Proof.
  induction w as [| e w IH]; intros v r; simpl; [tauto |]. unfold left in *. simpl. rewrite IH. apply derive_lang.
Qed.

(* The check: a state tells `match` (1) where what is left has the empty trace, `fail` (2) where no continuation matches,
   else nothing (0). *)

Section Expression.
  Variable r : word.
  Variable events : nat.
  Variable table : list (list nat).
  Variable verdicts : list nat.

  Definition tells (q v : nat) : bool := match nth_error verdicts q with Some x => x =? v | None => false end.

  (* From which states one that tells `match` can be reached, in at most so many steps *)
  Fixpoint alive (steps : nat) : list bool :=
    match steps with
    | 0 => map (fun v => v =? 1) verdicts
    | Datatypes.S steps =>
        let known := alive steps in
        map (fun q => nth q known false || existsb (fun e => nth (target table q e) known false) (seq 0 events))
          (seq 0 (length verdicts))
    end.

  Definition word_right (living : list bool) (s : word) (q : nat) : bool :=
    if nullable s then tells q 1
    else (tells q 2 && forallb (fun e => tells (target table q e) 2) (seq 0 events)) || (tells q 0 && nth q living false).

  Definition check_words (fuel start : nat) : bool :=
    let living := alive (length verdicts) in
    follow word same_word derive events table (word_right living) fuel [(r, start)] [].

  Lemma nth_map_seq : forall (f : nat -> bool) n q, nth q (map f (seq 0 n)) false = true -> f q = true.
  Proof.
    intros f n q H. destruct (lt_dec q n) as [L | L].
    - rewrite (nth_indep _ false (f 0)) in H by (now rewrite map_length, seq_length).
      rewrite map_nth, seq_nth in H; auto.
    - rewrite nth_overflow in H; [discriminate |]. rewrite map_length, seq_length. lia.
  Qed.

  Lemma alive_reaches : forall steps q, nth q (alive steps) false = true ->
    exists w, Forall (known events) w /\ tells (run table q w) 1 = true.
  Proof.
    induction steps as [| steps IH]; intros q H; simpl in H.
    - exists []. split; auto. unfold tells. simpl. destruct (nth_error verdicts q) as [x |] eqn:E.
      + now rewrite (nth_error_nth _ q false (map_nth_error (fun v => v =? 1) q verdicts E)) in H.
      + rewrite nth_overflow in H; [discriminate |]. rewrite map_length. now apply nth_error_None.
    - apply nth_map_seq in H. apply orb_true_iff in H. destruct H as [H | H]; auto.
      apply existsb_exists in H. destruct H as (e & E & H). destruct (IH _ H) as (w & F & T).
      exists (e :: w). split; auto. constructor; auto. apply in_seq in E. unfold known. lia.
  Qed.

  Lemma tells_one : forall q u v, tells q u = true -> tells q v = true -> u = v.
  Proof.
    unfold tells. intros q u v. destruct (nth_error verdicts q) as [x |]; [| discriminate].
    rewrite !Nat.eqb_eq. congruence.
  Qed.

  (* What is accepted tells `match` after the traces of the language, and `fail` after those that none of it begins with. *)
  Theorem check_words_sound : forall fuel start, check_words fuel start = true ->
    forall w, Forall (known events) w -> w <> [] ->
    exists verdict, nth_error verdicts (run table start w) = Some verdict /\
      (verdict = 1 <-> lang r w) /\
      (verdict = 2 <-> forall v, Forall (known events) v -> ~ lang r (w ++ v)).
  Proof.
    intros fuel start H. pose proof (follow_right _ _ _ _ _ _ _ _ _ H) as R. clear H.
    assert (M : forall w, Forall (known events) w -> w <> [] ->
        (tells (run table start w) 1 = true <-> lang r w)).
    { intros w F N. specialize (R w F N). unfold word_right in R. rewrite <- (app_nil_r w) at 2.
      rewrite <- left_lang, <- nullable_lang. destruct (nullable (left word derive r w)); [tauto |].
      split; [| discriminate]. intros T. apply orb_true_iff in R.
      destruct R as [R | R]; apply andb_true_iff in R; destruct R as [R _]; discriminate (tells_one _ _ _ T R). }
    assert (D : forall v w, Forall (known events) w -> w <> [] -> Forall (known events) v ->
        tells (run table start w) 2 = true -> tells (run table start (w ++ v)) 2 = true).
    { induction v as [| e v IH]; intros w F N G T; [now rewrite app_nil_r |]. inversion G; subst.
      change (e :: v) with ([e] ++ v). rewrite app_assoc. apply IH; auto.
      - apply Forall_app. auto.
      - destruct w; discriminate.
      - specialize (R w F N). unfold word_right in R. destruct (nullable _).
        + discriminate (tells_one _ _ _ R T).
        + apply orb_true_iff in R. destruct R as [R | R]; apply andb_true_iff in R; destruct R as [R S].
          * rewrite forallb_forall in S. unfold run. rewrite fold_left_app. simpl. apply S. apply in_seq.
            unfold known in H1. lia.
          * discriminate (tells_one _ _ _ R T). }
    intros w F N. specialize (R w F N) as A. unfold word_right in A.
    assert (V : exists v, nth_error verdicts (run table start w) = Some v).
    { unfold tells in A. destruct (nth_error verdicts _) as [v |]; [eauto |]. destruct (nullable _); discriminate. }
    destruct V as [v V]. exists v. split; auto.
    assert (T : forall n, tells (run table start w) n = true <-> v = n)
      by (intros n; unfold tells; rewrite V; apply Nat.eqb_eq).
    split; [rewrite <- T; auto |]. rewrite <- T. split.
    - intros K u G L. assert (X : tells (run table start (w ++ u)) 1 = true).
      { apply M; auto. apply Forall_app; auto. destruct w; [congruence | discriminate]. }
      discriminate (tells_one _ _ _ X (D _ _ F N G K)).
    - intros K. destruct (nullable _) eqn:E.
      + destruct (K [] (Forall_nil _)). rewrite app_nil_r. apply M; auto.
      + apply orb_true_iff in A. destruct A as [A | A]; apply andb_true_iff in A; destruct A as [A B]; auto.
        destruct (alive_reaches _ _ B) as (u & G & X). destruct (K u G). apply M.
        * apply Forall_app; auto.
        * destruct w; [congruence | discriminate].
        * unfold run in *. now rewrite fold_left_app.
  Qed.
End Expression.

Print Assumptions check_words_sound.
Print Assumptions check_machine_sound.

Require Import ExtrOcamlBasic ExtrOcamlNatInt.
Extraction "words.ml" check_words check_machine.
