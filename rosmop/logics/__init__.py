"""The logics of ``.rv`` properties: each compiles a formula and the events of its specification to a monitor.

``catalogue.compile_property`` is the entry point; ``interface`` defines what every logic offers. Each logic is a file.
"""
