(* Asks the extracted check of past.v, a line for each automaton:
   EVENTS START STATES, its rows, its verdicts (0 or 1), and the formula, operator first. Answers 1 or 0. *)

open Past

let rec formula = function
  | "event" :: number :: rest -> (Event (int_of_string number), rest)
  | "true" :: rest -> (Constant true, rest)
  | "false" :: rest -> (Constant false, rest)
  | "not" :: rest -> one (fun f -> Not f) rest
  | "previously" :: rest -> one (fun f -> Previously f) rest
  | "dual-previously" :: rest -> one (fun f -> DualPreviously f) rest
  | "once" :: rest -> one (fun f -> Once f) rest
  | "historically" :: rest -> one (fun f -> Historically f) rest
  | "and" :: rest -> two (fun f g -> And (f, g)) rest
  | "or" :: rest -> two (fun f g -> Or (f, g)) rest
  | "xor" :: rest -> two (fun f g -> Xor (f, g)) rest
  | "implies" :: rest -> two (fun f g -> Implies (f, g)) rest
  | "iff" :: rest -> two (fun f g -> Iff (f, g)) rest
  | "since" :: rest -> two (fun f g -> Since (f, g)) rest
  | "dual-since" :: rest -> two (fun f g -> DualSince (f, g)) rest
  | word :: _ -> failwith word
  | [] -> failwith "a formula ends early"

and one make rest = let f, rest = formula rest in (make f, rest)
and two make rest = let f, rest = formula rest in let g, rest = formula rest in (make f g, rest)

let rec numbers count words =
  if count = 0 then ([], words)
  else match words with
    | word :: rest -> let tail, rest = numbers (count - 1) rest in (int_of_string word :: tail, rest)
    | [] -> failwith "numbers are missing"

let rec rows count events words =
  if count = 0 then ([], words)
  else let row, rest = numbers events words in
    let tail, rest = rows (count - 1) events rest in (row :: tail, rest)

let answer line =
  match numbers 3 (String.split_on_char ' ' line) with
  | [events; start; states], rest ->
    let table, rest = rows states events rest in
    let verdicts, rest = numbers states rest in
    let formula, rest = formula rest in
    if rest <> [] then failwith "something is left";
    check formula events table (List.map (fun verdict -> verdict = 1) verdicts) 1000000 start
  | _ -> failwith line

let () =
  try while true do print_endline (if answer (input_line stdin) then "1" else "0") done
  with End_of_file -> ()
