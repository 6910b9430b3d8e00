"""The access policy: INI text in, `Policy` out; `Policy.decide(request)` is a pure function.

Without I/O and without a clock, decisions can be tested, explained and proved.
"""
