"""What the running appliance answers operators' tools: a struct for each question, the same for all who read it.

RVMaster makes them (`appliance.control`), the admin socket and the link to the api carry them, and REST, `rosrv` and
the metrics read them. The contract of REST is made from them, too: their names, types and descriptions are those of
the JSON that clients see. Which question is answered by which struct is said in `appliance.channel.admin`.
"""
