from pop_ref.conformance.laws.test_thresholds import *  # noqa: F403  over our backends
