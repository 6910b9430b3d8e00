"""The logics of ``.rv`` properties: each logic compiles a formula and the events of its specification to a monitor.

``catalogue.compile_property`` is the entry point; ``interface`` defines what every logic offers. Each logic has its own
file.
"""
