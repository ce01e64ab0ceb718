from pop_ref.conformance.laws.test_optimizer import *  # noqa: F403  the laws of one stage, over the host mirror
