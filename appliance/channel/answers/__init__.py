"""The running appliance's answers to operators' tools: a struct for each question, the same for all readers.

RVMaster makes them (`appliance.control`), the admin socket and the link to the api carry them, and REST, `rosrv` and
the metrics read them. The contract of REST is also made from them: their names, types and descriptions are those of
the JSON that clients see. `appliance.channel.admin` maps each question to its struct.
"""
