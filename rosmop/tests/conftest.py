from hypothesis import settings

from rosmop.tests.examples import examples

# The time of an example depends on the load of the machine.
settings.register_profile("no clock", deadline=None, max_examples=examples(100))
settings.load_profile("no clock")
