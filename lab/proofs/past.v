(* The check of a `ptltl` automaton is sound: what it accepts says, after every trace, whether the formula holds.

   `check` below is `_check_past` of rosmop/certify/check.py, which follows `Past` of past.py there: a formula is
   followed event by event beside the automaton, through all pairs that can be reached. `holds` is the definition of the
   logic; nothing of the check is in it. It is extracted, and compared with the Python (lab/tests/proofs/test_certifier.py). *)

Require Import List Bool Arith Lia.
Import ListNotations.

Inductive formula :=
  | Event (event : nat)
  | Constant (value : bool)
  | Not (f : formula)
  | And (f g : formula)
  | Or (f g : formula)
  | Xor (f g : formula)
  | Implies (f g : formula)
  | Iff (f g : formula)
  | Previously (f : formula)
  | DualPreviously (f : formula)
  | Once (f : formula)
  | Historically (f : formula)
  | Since (f g : formula)
  | DualSince (f g : formula).

(* A trace is the list of its events, the latest first. `since t f g`: at some position of the past g held, and f did at
   all after it. *)

Definition since (t : list nat) (f g : list nat -> Prop) : Prop :=
  exists recent past, t = recent ++ past /\ past <> [] /\ g past /\
    forall later earlier, recent = later ++ earlier -> earlier <> [] -> f (earlier ++ past).

Fixpoint holds (f : formula) (t : list nat) : Prop :=
  match f with
  | Event e => exists past, t = e :: past
  | Constant b => b = true
  | Not f => ~ holds f t
  | And f g => holds f t /\ holds g t
  | Or f g => holds f t \/ holds g t
  | Xor f g => ~ (holds f t <-> holds g t)
  | Implies f g => holds f t -> holds g t
  | Iff f g => holds f t <-> holds g t
  | Previously f => exists e past, t = e :: past /\ past <> [] /\ holds f past
  | DualPreviously f => forall e past, t = e :: past -> past <> [] -> holds f past
  | Once f => exists recent past, t = recent ++ past /\ past <> [] /\ holds f past
  | Historically f => forall recent past, t = recent ++ past -> past <> [] -> holds f past
  | Since f g => since t (holds f) (holds g)
  | DualSince f g => ~ since t (fun s => ~ holds f s) (fun s => ~ holds g s)
  end.

(* What is remembered of the event before: a bit for each part that looks back. *)

Inductive memory := Nothing | Both (m n : memory) | Kept (bit : bool) (m : memory) | KeptBoth (bit : bool) (m n : memory).

Fixpoint initial (f : formula) : memory :=
  match f with
  | Event _ | Constant _ => Nothing
  | Not f => initial f
  | And f g | Or f g | Xor f g | Implies f g | Iff f g => Both (initial f) (initial g)
  | Previously f | Once f => Kept false (initial f)
  | DualPreviously f | Historically f => Kept true (initial f)
  | Since f g => KeptBoth false (initial f) (initial g)
  | DualSince f g => KeptBoth true (initial f) (initial g)
  end.

Definition value (f : formula) (x y before : bool) : bool :=
  match f with
  | And _ _ => x && y
  | Or _ _ => x || y
  | Xor _ _ => xorb x y
  | Implies _ _ => implb x y
  | Iff _ _ => Bool.eqb x y
  | Once _ => x || before
  | Historically _ => x && before
  | Since _ _ => y || (x && before)
  | DualSince _ _ => y && (x || before)
  | _ => x
  end.

Fixpoint step (f : formula) (m : memory) (e : nat) : memory * bool :=
  match f, m with
  | Event x, _ => (Nothing, x =? e)
  | Constant b, _ => (Nothing, b)
  | Not f, m => let (m', x) := step f m e in (m', negb x)
  | (And g h | Or g h | Xor g h | Implies g h | Iff g h), Both m n =>
      let (m', x) := step g m e in let (n', y) := step h n e in (Both m' n', value f x y false)
  | (Previously g | DualPreviously g), Kept bit m => let (m', x) := step g m e in (Kept x m', bit)
  | (Once g | Historically g), Kept bit m =>
      let (m', x) := step g m e in let v := value f x x bit in (Kept v m', v)
  | (Since g h | DualSince g h), KeptBoth bit m n =>
      let (m', x) := step g m e in let (n', y) := step h n e in
      let v := value f x y bit in (KeptBoth v m' n', v)
  | _, _ => (m, false)
  end.

(* `good f t m`: m is what is to be remembered of f after t. *)

Definition is (bit : bool) (P : Prop) : Prop := bit = true <-> P.

Fixpoint good (f : formula) (t : list nat) (m : memory) : Prop :=
  match f, m with
  | (Event _ | Constant _), Nothing => True
  | Not f, m => good f t m
  | (And g h | Or g h | Xor g h | Implies g h | Iff g h), Both m n => good g t m /\ good h t n
  | Previously g, Kept bit m => good g t m /\ is bit (t <> [] /\ holds g t)
  | DualPreviously g, Kept bit m => good g t m /\ is bit (t <> [] -> holds g t)
  | (Once g | Historically g), Kept bit m => good g t m /\ is bit (holds f t)
  | (Since g h | DualSince g h), KeptBoth bit m n => good g t m /\ good h t n /\ is bit (holds f t)
  | _, _ => False
  end.

Lemma app_nil_split : forall (a b : list nat), [] = a ++ b -> a = [] /\ b = [].
Proof. intros a b H; symmetry in H; apply app_eq_nil in H; auto. Qed.

Lemma since_nil : forall f g, ~ since [] f g.
Proof. intros f g (r & p & H & N & _). apply app_nil_split in H. tauto. Qed.

Lemma good_initial : forall f, good f [] (initial f).
Proof.
  induction f; simpl; unfold is; auto; repeat split; auto; try discriminate; try tauto; intros.
  - destruct H as (r & p & H & N & _). apply app_nil_split in H. tauto.
  - apply app_nil_split in H0. tauto.
  - destruct (since_nil _ _ H).
  - intro. destruct (since_nil _ _ H0).
Qed.

Lemma since_step : forall e t f g, since (e :: t) f g <-> g (e :: t) \/ (f (e :: t) /\ since t f g).
Proof.
  intros e t f g. split.
  - intros (r & p & H & N & G & F). destruct r as [| x r]; simpl in H.
    + subst p. auto.
    + injection H as -> ->. right. split.
      * apply (F [] (x :: r)); auto. discriminate.
      * exists r, p. repeat split; auto. intros l k E K. apply (F (x :: l) k); auto. simpl. now rewrite E.
  - intros [G | (F & r & p & H & N & G & K)].
    + exists [], (e :: t). repeat split; auto; try discriminate.
      intros l k E Q. apply app_nil_split in E. tauto.
    + exists (e :: r), p. subst t. repeat split; auto. intros l k E Q.
      destruct l as [| x l]; simpl in E.
      * subst k. exact F.
      * injection E as -> E. apply (K l k); auto.
Qed.

Lemma once_step : forall e t (f : list nat -> Prop),
  (exists r p, e :: t = r ++ p /\ p <> [] /\ f p) <-> f (e :: t) \/ exists r p, t = r ++ p /\ p <> [] /\ f p.
Proof.
  intros e t f. split.
  - intros ([| x r] & p & H & N & F); simpl in H.
    + subst p. auto.
    + injection H as -> ->. right. now exists r, p.
  - intros [F | (r & p & H & N & F)].
    + exists [], (e :: t). repeat split; auto; discriminate.
    + exists (e :: r), p. subst t. auto.
Qed.

Lemma historically_step : forall e t (f : list nat -> Prop),
  (forall r p, e :: t = r ++ p -> p <> [] -> f p) <-> f (e :: t) /\ forall r p, t = r ++ p -> p <> [] -> f p.
Proof.
  intros e t f. split.
  - intros H. split.
    + apply (H [] (e :: t)); auto; discriminate.
    + intros r p E N. apply (H (e :: r) p); auto. simpl. now rewrite E.
  - intros (F & H) [| x r] p E N; simpl in E.
    + now subst p.
    + injection E as -> E. now apply (H r p).
Qed.

Lemma since_weaken : forall t (f f' g g' : list nat -> Prop),
  (forall s, f s <-> f' s) -> (forall s, g s <-> g' s) -> since t f g -> since t f' g'.
Proof.
  intros t f f' g g' F G (r & p & H & N & K & L). exists r, p. repeat split; auto.
  - now apply G.
  - intros. apply F. eapply L; eauto.
Qed.

Lemma said : forall b P, is b P -> if b then P else ~ P.
Proof. intros [] P [A B]; auto. intro H. discriminate (B H). Qed.

Ltac follow IH t m e G :=
  let H := fresh in let m' := fresh "m" in let x := fresh "x" in let A := fresh in let B := fresh in
  pose proof (IH t m e G) as H; destruct (step _ m e) as [m' x]; simpl in H; destruct H as [A B]; apply said in B.

Lemma step_good : forall f t m e, good f t m ->
  good f (e :: t) (fst (step f m e)) /\ is (snd (step f m e)) (holds f (e :: t)).
Proof.
  induction f; intros t m e G; simpl in G; try (destruct m; try tauto; [idtac]).
  - simpl. split; auto. unfold is. rewrite Nat.eqb_eq. split.
    + intros ->. now exists t.
    + intros (p & H). injection H; auto.
  - simpl. unfold is. tauto.
  - simpl. follow IHf t m e G. simpl. split; auto. unfold is. destruct x; simpl; intuition discriminate.
  - destruct G as [G1 G2]. simpl. follow IHf1 t m1 e G1. follow IHf2 t m2 e G2. simpl. unfold is.
    destruct x, x0; simpl; intuition discriminate.
  - destruct G as [G1 G2]. simpl. follow IHf1 t m1 e G1. follow IHf2 t m2 e G2. simpl. unfold is.
    destruct x, x0; simpl; intuition discriminate.
  - destruct G as [G1 G2]. simpl. follow IHf1 t m1 e G1. follow IHf2 t m2 e G2. simpl. unfold is.
    destruct x, x0; simpl; intuition discriminate.
  - destruct G as [G1 G2]. simpl. follow IHf1 t m1 e G1. follow IHf2 t m2 e G2. simpl. unfold is.
    destruct x, x0; simpl; intuition discriminate.
  - destruct G as [G1 G2]. simpl. follow IHf1 t m1 e G1. follow IHf2 t m2 e G2. simpl. unfold is.
    destruct x, x0; simpl; intuition discriminate.
  - destruct G as [G B0]. simpl. follow IHf t m e G. simpl. split.
    + split; auto. unfold is. destruct x; split; intuition discriminate.
    + unfold is in *. rewrite B0. split.
      * intros [N H]. exists e, t. auto.
      * intros (a & p & E & N & H). injection E as -> ->. auto.
  - destruct G as [G B0]. simpl. follow IHf t m e G. simpl. split.
    + split; auto. unfold is. destruct x; split; intuition discriminate.
    + unfold is in *. rewrite B0. split.
      * intros H a p E N. injection E as -> ->. auto.
      * intros H N. apply (H e t); auto.
  - destruct G as [G B0]. apply said in B0. simpl. follow IHf t m e G. simpl.
    assert (V : is (x || bit) (holds (Once f) (e :: t))).
    { unfold is. simpl holds. rewrite once_step. simpl in B0. destruct x, bit; simpl; intuition discriminate. }
    repeat split; auto; apply V.
  - destruct G as [G B0]. apply said in B0. simpl. follow IHf t m e G. simpl.
    assert (V : is (x && bit) (holds (Historically f) (e :: t))).
    { unfold is. simpl holds. rewrite historically_step. simpl in B0. destruct x, bit; simpl; intuition discriminate. }
    repeat split; auto; apply V.
  - destruct G as (G1 & G2 & B0). apply said in B0. simpl. follow IHf1 t m1 e G1. follow IHf2 t m2 e G2. simpl.
    assert (V : is (x0 || (x && bit)) (holds (Since f1 f2) (e :: t))).
    { unfold is. simpl holds. rewrite since_step. simpl in B0. destruct x, x0, bit; simpl; intuition discriminate. }
    repeat split; auto; apply V.
  - destruct G as (G1 & G2 & B0). apply said in B0. simpl. follow IHf1 t m1 e G1. follow IHf2 t m2 e G2. simpl.
    assert (V : is (x0 && (x || bit)) (holds (DualSince f1 f2) (e :: t))).
    { unfold is. simpl holds. rewrite since_step. simpl in B0. destruct x, x0, bit; simpl; intuition discriminate. }
    repeat split; auto; apply V.
Qed.

(* The check. An automaton has a state to begin in, a row for each state with the state that each event leads to, and the
   verdict that is told after a step into a state. *)

Definition pair := (memory * nat)%type.

Definition pair_eq : forall p q : pair, {p = q} + {p <> q}.
Proof. repeat decide equality. Defined.

Section Check.
  Variable f : formula.
  Variable events : nat.
  Variable table : list (list nat).
  Variable verdicts : list bool.

  Definition target (q e : nat) : nat := nth e (nth q table []) 0.
  Definition after (p : pair) (e : nat) : pair := (fst (step f (fst p) e), target (snd p) e).
  Definition right (p : pair) (e : nat) : bool :=
    match nth_error verdicts (target (snd p) e) with
    | Some v => Bool.eqb v (snd (step f (fst p) e))
    | None => false
    end.
  Definition fine (p : pair) : bool :=
    (length (nth (snd p) table []) =? events) && forallb (right p) (seq 0 events).

  Fixpoint follow (fuel : nat) (waiting seen : list pair) : bool :=
    match fuel, waiting with
    | 0, _ => false
    | S _, [] => true
    | S fuel, p :: waiting =>
        if in_dec pair_eq p seen then follow fuel waiting seen
        else if fine p then follow fuel (map (after p) (seq 0 events) ++ waiting) (p :: seen)
        else false
    end.

  Definition check (fuel start : nat) : bool := follow fuel [(initial f, start)] [].

  Definition closed (seen waiting : list pair) : Prop :=
    forall p, In p seen -> fine p = true /\ forall e, e < events -> In (after p e) (seen ++ waiting).

  Lemma follow_closed : forall fuel waiting seen, closed seen waiting -> follow fuel waiting seen = true ->
    exists all, incl (seen ++ waiting) all /\ closed all [].
  Proof.
    induction fuel as [| fuel IH]; intros waiting seen C H; [discriminate |].
    destruct waiting as [| p waiting]; simpl in H.
    - exists seen. rewrite app_nil_r. split; auto. apply incl_refl.
    - destruct (in_dec pair_eq p seen) as [I | I].
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

  Fixpoint run (start : nat) (t : list nat) : nat :=
    match t with [] => start | e :: past => target (run start past) e end.

  Fixpoint remembered (t : list nat) : memory :=
    match t with [] => initial f | e :: past => fst (step f (remembered past) e) end.

  Lemma remembered_good : forall t, good f t (remembered t).
  Proof.
    induction t as [| e t IH]; simpl.
    - apply good_initial.
    - now apply step_good.
  Qed.

  (* What is accepted says after every trace, of events that there are, whether the formula holds. *)
  Theorem check_sound : forall fuel start, check fuel start = true ->
    forall e past, Forall (fun x => x < events) (e :: past) ->
    exists verdict, nth_error verdicts (run start (e :: past)) = Some verdict /\
      (verdict = true <-> holds f (e :: past)).
  Proof.
    intros fuel start H. destruct (follow_closed _ _ _ (fun p (N : In p []) => match N with end) H) as (all & A & C).
    assert (R : forall t, Forall (fun x => x < events) t -> In (remembered t, run start t) all).
    { induction t as [| e t IH]; intros F.
      - apply A. simpl. auto.
      - inversion F; subst. destruct (C _ (IH H3)) as [_ N]. specialize (N e H2). rewrite app_nil_r in N. exact N. }
    intros e past F. inversion F; subst. destruct (C _ (R past H3)) as [G _].
    unfold fine in G. apply andb_prop in G. destruct G as [_ G]. rewrite forallb_forall in G.
    specialize (G e). rewrite in_seq in G. specialize (G (conj (Nat.le_0_l e) H2)). unfold right in G. simpl in *.
    destruct (nth_error verdicts (target (run start past) e)) as [v |]; [| discriminate].
    exists v. split; auto. apply eqb_prop in G. subst v. apply step_good. apply remembered_good.
  Qed.
End Check.

Print Assumptions check_sound.

Require Import ExtrOcamlBasic ExtrOcamlNatInt.
Extraction "past.ml" check.
