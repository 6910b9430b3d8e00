"""The ``.rv`` language: specifications of monitors, compiled to functions over the bytes of ROS messages.

`syntax` reads the text, `types` knows what values are, `compile` makes functions, `runtime` is what they call,
`logics` makes monitors from formulas, `engine` runs it all. Pure: no I/O, no clock, no globals.
"""
