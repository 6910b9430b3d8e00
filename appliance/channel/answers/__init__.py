"""The running appliance's answers to operators' tools: one struct for each request, the same for all readers.

Control makes the answers. The admin socket and the link to the api carry them. REST, `rosrv` and the metrics read them.
The REST contract is generated from these structs, so clients see their names, types and descriptions.
`appliance.channel.admin` maps each request to the struct of its answer.
"""
