"""The ``.rv`` language: specifications of monitors over the bytes of ROS messages.

`text` parses, `types` knows the types of values, `logics` makes monitors from formulas, `check` type-checks and
lowers to the intermediate form in `form`. `run` interprets that form, which defines the meaning; `fast` translates
parts of it to WebAssembly. `runtime` has the functions that specifications call. `tool` is the command. Apart from
`tool`, the package does no I/O and reads no clock.
"""
