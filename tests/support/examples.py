"""Run a twelfth of a property's examples each time, and all in `make nightly`.

With `CI=true` Hypothesis derives the seed from the test; otherwise each run has a new seed.
"""

from rosmop.tests.examples import ALL, covering, examples, sample, seeds_of_night

__all__ = ["ALL", "covering", "examples", "sample", "seeds_of_night"]
