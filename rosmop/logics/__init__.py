"""The logics of ``.rv`` properties: each file compiles the formulas of a logic to monitors."""
