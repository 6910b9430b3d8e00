"""The access policy. A `Policy` is compiled from INI text; `Policy.decide(request)` is a pure function.

Decisions use no I/O and no clock, so they can be tested, explained and proved.
"""
