"""Run specifications: interpreter, engine, slices, timers, explanations. No I/O, no clock."""
