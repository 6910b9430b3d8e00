"""The logics of ``.rv`` properties, as pure code: a formula and the events of its specification go in, a
monitor comes out.

``catalogue.compile_property`` is the way in; ``interface`` says what every logic offers. One file per logic.
"""
