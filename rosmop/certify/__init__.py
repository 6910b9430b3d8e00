"""Holds what the compilers of the logics make against the logics' definitions, with code of its own.

Nothing here is shared with `rosmop/logics`: the formula is read again from its text, and its meaning is followed event
by event beside the automaton (`check.py`). What was not followed to its end is said so, never passed over.
"""
