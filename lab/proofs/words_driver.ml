(* Asks the extracted checks of words.v, a line for each automaton: EVENTS START STATES, its rows, its verdicts, and
   `ere` with the expression, operator first (verdicts: 0 nothing, 1 match, 2 fail), or
   `fsm` BEGINS STATES, the rows and verdicts as they are written (verdicts are numbers of sets). Answers 1 or 0. *)

open Words

let rec word = function
  | "event" :: number :: rest -> (Event (int_of_string number), rest)
  | "empty" :: rest -> (Empty, rest)
  | "epsilon" :: rest -> (Epsilon, rest)
  | "not" :: rest -> let r, rest = word rest in (Not r, rest)
  | "star" :: rest -> let r, rest = word rest in (Star r, rest)
  | "sequence" :: rest -> two (fun r s -> Seq (r, s)) rest
  | "union" :: rest -> two (fun r s -> Or (r, s)) rest
  | "intersection" :: rest -> two (fun r s -> And (r, s)) rest
  | word :: _ -> failwith word
  | [] -> failwith "an expression ends early"

and two make rest = let r, rest = word rest in let s, rest = word rest in (make r s, rest)

let rec numbers count words =
  if count = 0 then ([], words)
  else match words with
    | word :: rest -> let tail, rest = numbers (count - 1) rest in (int_of_string word :: tail, rest)
    | [] -> failwith "numbers are missing"

let rec rows count events words =
  if count = 0 then ([], words)
  else let row, rest = numbers events words in
    let tail, rest = rows (count - 1) events rest in (row :: tail, rest)

let nothing_after = function [] -> () | _ -> failwith "something is left"

let answer line =
  match numbers 3 (String.split_on_char ' ' line) with
  | [events; start; states], rest ->
    let table, rest = rows states events rest in
    let verdicts, rest = numbers states rest in
    (match rest with
     | "ere" :: rest ->
       let r, rest = word rest in
       nothing_after rest;
       check_words r events table verdicts 1000000 start
     | "fsm" :: rest ->
       (match numbers 2 rest with
        | [begins; states], rest ->
          let written, rest = rows states events rest in
          let tells, rest = numbers states rest in
          nothing_after rest;
          let alone = List.map (fun verdict -> [verdict]) in
          check_machine events written (alone tells) begins table (alone verdicts) 1000000 start
        | _ -> failwith line)
     | _ -> failwith line)
  | _ -> failwith line

let () =
  try while true do print_endline (if answer (input_line stdin) then "1" else "0") done
  with End_of_file -> ()
