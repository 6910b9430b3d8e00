"""The access policy: INI text in, `Policy` out; `Policy.decide(request)` is a pure function.

No I/O and no clock: that is what makes a decision testable, explainable and provable.
"""
