"""The running appliance's answers to operators' tools: one struct for each request, the same for all readers.

The REST contract is generated from these structs, with their names, types and descriptions.
"""
