"""Check compiled automata against the definitions of their logics.

The definitions share no code with the compilers in `rosmop/logics`.
"""
