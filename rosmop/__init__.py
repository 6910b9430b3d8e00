"""The ``.rv`` language: specifications of monitors, compiled to functions over the bytes of ROS messages.

`syntax` reads the text, `types` knows what values are, `compile` checks it and writes it in the form that `ir` defines,
runs plainly and writes as modules; `runtime` is what that calls, `logics` makes monitors from formulas, `engine` runs
it all. Pure: no I/O, no clock, no globals.
"""
