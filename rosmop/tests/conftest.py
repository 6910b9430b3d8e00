"""Settings that all tests of the language share."""

from hypothesis import settings

from rosmop.tests.examples import examples

# The time an example takes depends on what else the machine does.
settings.register_profile("no clock", deadline=None, max_examples=examples(100))
settings.load_profile("no clock")
