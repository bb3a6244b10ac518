import os
import signal
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import settings

from misstep import MisstepError, demonstrate, make_system
from misstep.learners import LEARNERS

settings.register_profile("default", deadline=None, derandomize=True, max_examples=100)
settings.register_profile("nightly", deadline=None, max_examples=10_000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))

# A shell that runs the tests in the background has interrupts ignored, and so would every program
# that is started here and interrupted to see what it does.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def refused():
    """Expect a MisstepError of one line whose message matches."""

    @contextmanager
    def expect(match):
        with pytest.raises(MisstepError, match=match) as caught:
            yield
        assert "\n" not in str(caught.value)

    return expect


@pytest.fixture(scope="session")
def random_mixture():
    """Draw weights (K,), means (K, d) and covariances (K, d, d) of overlapping components."""

    def draw(rng, K, d, spread=2.0):
        factors = rng.normal(size=(K, d, d)) / np.sqrt(d)
        covariances = factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(d)
        return rng.dirichlet(np.full(K, 3.0)), spread * rng.normal(size=(K, d)), covariances

    return draw


@pytest.fixture
def scripted(monkeypatch):
    """A learner whose policies answer what a test says."""
    from robots import scripted_learner

    kind = scripted_learner()
    monkeypatch.setitem(LEARNERS._own, "scripted", kind)
    return kind.scripted


@pytest.fixture(scope="session")
def cartpole():
    return make_system("cartpole")


@pytest.fixture(scope="session")
def demonstrations(cartpole):
    return demonstrate(cartpole, by="weak", n=3, seed=0)
