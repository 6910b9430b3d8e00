"""The running appliance's answers to operators' tools: one struct for each request, the same for all readers.

The REST contract is generated from these structs, so clients see their names, types and descriptions.
`appliance.channel.admin` maps each request to the struct of its answer.
"""
