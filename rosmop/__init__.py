"""The ``.rv`` language: specifications of monitors over the bytes of ROS messages.

`text` parses, `types` defines the types of values, `logics` makes monitors from formulas, and `check` type-checks and
lowers to the intermediate form in `form`. `run` interprets this form, which defines its meaning. `fast` translates
parts of the form to WebAssembly. `runtime` implements the functions that specifications call. `tool` is the command.
Apart from `tool`, the package does no I/O and reads no clock.
"""
